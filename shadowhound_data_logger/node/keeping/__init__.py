"""Objects kept on the robot until requested, and the rules that uploads wait for."""
