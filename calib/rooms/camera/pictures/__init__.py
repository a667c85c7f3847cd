"""Boards to print, and corner detection in their images (files or bags)."""
