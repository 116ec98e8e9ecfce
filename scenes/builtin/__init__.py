"""The built-in room: a furnished room with known truth that measures reconstructions."""
