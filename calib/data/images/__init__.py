"""Images of a board: boards to print, corners found in images and bags, lenses, as measurements."""
