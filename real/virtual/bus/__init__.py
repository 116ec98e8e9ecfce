"""The virtual bus: Dynamixel Protocol 2.0 devices behind a cable."""
