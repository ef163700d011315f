"""The live page: shows a robot, its data and what is missing in a browser. It runs in a separate process next to the node."""
