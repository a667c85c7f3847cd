"""From a printed board and images of it, files or bags, to its corners."""
