"""Turns samples into objects: one file per format. Needs no ROS: message definitions are text.

A message becomes bytes of a format, or is rejected with a reason. ``mcap/`` reads, writes and repairs slices of bags; ``rows/``
defines rows, written without the libraries that read them.
"""
