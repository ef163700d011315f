"""Reads topics raw and polled, through what rclpy of each distribution and each middleware offer."""
