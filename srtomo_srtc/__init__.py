"""Soft real time: telemetry in, reconstructors out. Only ``node.py`` imports ROS."""
