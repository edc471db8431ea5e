"""Studies that decide defaults: each writes summary.json, CSV and PNG into a folder."""
