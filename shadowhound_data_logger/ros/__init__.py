"""Polled raw subscriptions, for the rclpy of each distribution and each middleware.

Outside of this folder and ``node/``, only ``doctor/ros_watch.py`` and ``live/topics.py`` import rclpy.
"""
