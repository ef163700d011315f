"""The live page: shows a robot, its data and what is missing in a browser. A process of its own, beside the node."""
