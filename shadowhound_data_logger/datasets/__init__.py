"""Training sets from missions: LeRobot v3.0, one episode per mission, with stated gaps and the source of every value.

``shadowhound-data export`` (docs/datasets.md). ``plan.py`` decides which missions can be exported, ``series.py`` reads their
messages, ``ticks.py`` samples them, ``episodes.py`` writes one episode, ``lerobot_writer.py`` assembles the dataset,
``export.py`` runs all of it.
"""
