"""The Robotis OP3 humanoid: its constants, its link table and its composer entity."""
