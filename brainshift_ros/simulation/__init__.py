"""Simulated truths and scans, for the demo, tests and studies. Nothing in surgery imports this."""
