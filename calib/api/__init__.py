"""What stands behind the names of `calib`: the procedure's stages as verbs, and results that print themselves."""
