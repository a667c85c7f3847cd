"""Results, read from the folders or files that commands wrote: one protocol for all kinds, and
scenes for the viewer.
"""
