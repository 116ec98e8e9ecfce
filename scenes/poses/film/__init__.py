"""What only a film knows: when each picture was taken, so that a hand moves and a shutter rolls."""
