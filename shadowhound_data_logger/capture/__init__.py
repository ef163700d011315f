"""The only folder that imports rclpy: messages are taken from DDS here and handed on as they came."""
