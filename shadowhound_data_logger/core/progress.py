"""Who is told how far a transfer is."""


class ProgressListener:
    """Is told how far a transfer is; any thread calls it. This one ignores it."""

    def begin(self, total: int) -> None:
        """The transfer has this many bytes in all."""

    def have(self, count: int) -> None:
        """This many more are here, downloaded or there already; negative for those that turned out wrong."""
