"""ShadowHound data logger: a robot's data off the robot, whole and trusted."""

__all__: list[str] = []
