"""Training sets from missions: LeRobot v3.0, one mission an episode, with what is missing stated and every value traced.

``shadowhound-data export`` (docs/datasets.md). ``plan.py`` says which missions can be exported, ``series.py`` reads what they
recorded, ``ticks.py`` samples it, ``episodes.py`` writes one, ``lerobot.py`` puts them together, ``export.py`` runs it all.
"""
