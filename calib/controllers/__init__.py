"""Robot controllers: what each displays, and which programs and settings it accepts."""
