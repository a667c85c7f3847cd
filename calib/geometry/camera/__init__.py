"""What images say of the geometry: first guesses, residuals of corners."""
