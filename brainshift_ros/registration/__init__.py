"""Scans from tracker space to patient space."""
