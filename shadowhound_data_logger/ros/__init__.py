"""Polled raw subscriptions, for the rclpy of each distribution and each middleware."""
