"""Two calibrations of one robot compared: geometry, dynamics, or both."""
