"""Robot controllers: the joint values that each displays, and the programs and settings that it accepts."""
