"""What draws figures in the browser: uPlot as published (``vendored.toml``), and ``figures.js`` on it."""
