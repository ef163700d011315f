"""From the robot to closed batches: the only folder that imports rclpy. Messages are taken from DDS and handed on as they came."""
