"""From the robot to closed batches: the only folder that imports rclpy. Messages are handed on as they came."""
