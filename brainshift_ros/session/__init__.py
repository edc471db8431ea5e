"""One case at the scanner, from scans to homologous points, without ROS."""
