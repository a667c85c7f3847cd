"""Results, read from the folders or files that commands wrote.

All kinds of results implement one protocol. The modules on scenes prepare results for the viewer.
"""
