"""Turns samples into objects: one file per format. Needs no ROS: message definitions are text."""
