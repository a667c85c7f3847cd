"""Virtual cells with known truth: robots, instruments and errors for demonstrations, studies and tests."""
