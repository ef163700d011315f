"""When each sensor is due: absolute times that do not drift, in order, none left out."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Mapping


def count(rate_hz: float, duration_s: float) -> int:
    """How many samples at 0, 1/rate, 2/rate, ... s lie before ``duration_s``; a product within 1e-6 of a whole is that whole."""
    return math.ceil(rate_hz * duration_s - 1e-6)


def schedule(rates_hz: Mapping[str, float], duration_s: float) -> Iterator[tuple[float, str]]:
    """(seconds since the start, name) of every sample in the order of time, for ever where ``duration_s`` is 0."""
    order = list(rates_hz)
    last = {name: count(rates_hz[name], duration_s) if duration_s else math.inf for name in order}
    heap = [(0.0, place, 0) for place, name in enumerate(order) if last[name] > 0]
    heapq.heapify(heap)
    while heap:
        due, place, number = heap[0]
        name = order[place]
        yield due, name
        following = number + 1
        if following < last[name]:
            heapq.heapreplace(heap, (following / rates_hz[name], place, following))
        else:
            heapq.heappop(heap)
