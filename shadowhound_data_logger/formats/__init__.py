"""From samples to finished objects: one registry of formats, one file a format. Needs no ROS: definitions come as text."""
