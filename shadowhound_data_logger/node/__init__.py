"""From the robot to closed batches: all of the node that imports rclpy. Messages are handed on as they came."""
