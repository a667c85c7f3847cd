"""Figures as values (`charts`), and what draws them: matplotlib, SVG for print, and the browser."""
