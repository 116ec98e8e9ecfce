"""Search of sets of effects at one joint, scored by left-out likelihood."""
