"""What stays on the robot until it is requested, and the rules that uploads wait for."""
