"""Images in the fit of the geometry: first guesses of camera and board, residuals of corners."""
