"""Figures anyone can print again: scene, method, figure, ratio, as Markdown on stdout."""
