"""The live page: shows a robot, its data and what is missing in a browser. It runs in a separate process next to the node.

``server.py`` assembles it, ``auth.py`` and ``access.py`` decide who may do what, ``viewer.py`` what each browser is sent,
``topics.py`` subscribes, ``history_process.py`` reads the past in a child, ``relay.py`` relays a robot's page. ``viewer.py``,
``kinds.py`` and ``page/link.js`` describe the protocol between page and server, which is internal. Elements of the page with
figures have the attributes ``data-topic`` and ``data-field`` (``received stored missed rate age``).
"""
