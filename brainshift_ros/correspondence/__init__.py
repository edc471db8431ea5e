"""Vessels on the cortex, and homologous points between scans."""
