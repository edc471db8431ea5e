"""Vessels in the texture of a scan: enhanced, traced, measured."""
