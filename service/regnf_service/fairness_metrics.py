"""How callers share the workers, for Prometheus. The names of callers are labels, so only so many are told apart."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric

from regnf_state.redis.counters import Counters
from regnf_state.redis.fair_queue import FairQueue

_MOST_CALLERS = 32
OTHER = "other"
"""The label of all the rest."""


def fairness_metrics(fair: FairQueue, counters: Counters) -> Iterator[Metric]:
    """What each caller has waiting, for how long, and what its work has cost."""
    spent = {tuple(labels): value for labels, value in counters.counts("worker_seconds")}
    totals: dict[str, float] = defaultdict(float)
    for (owner, _), value in spent.items():
        totals[owner] += value
    lines = {line.owner: line for line in fair.lines()}
    shown = _told_apart([*lines, *sorted(totals, key=lambda owner: -totals[owner])])
    seconds = CounterMetricFamily("regnf_worker_seconds", "Time of workers by caller.", labels=("caller", "kind"))
    for labels, value in sorted(_summed(spent.items(), shown).items()):
        seconds.add_metric(labels, value)
    yield seconds
    waiting = _by_caller("waiting", "Jobs and imports that wait, by caller.")
    oldest = _by_caller("wait_seconds", "How long the first of them has waited.")
    lead = _by_caller("lead_seconds", "Worker seconds that a caller has had beyond who is served now.")
    for owner, line in lines.items():
        if owner in shown:
            waiting.add_metric((owner,), line.waiting)
            oldest.add_metric((owner,), line.oldest_s)
            lead.add_metric((owner,), line.lead_s)
    rest = [line for owner, line in lines.items() if owner not in shown]
    if rest:
        waiting.add_metric((OTHER,), sum(line.waiting for line in rest))
        oldest.add_metric((OTHER,), max(line.oldest_s for line in rest))
        lead.add_metric((OTHER,), max(line.lead_s for line in rest))
    yield from (waiting, oldest, lead)


def _by_caller(name: str, about: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"regnf_caller_{name}", about, labels=("caller",))


def _told_apart(owners: Iterable[str]) -> set[str]:
    """The first so many; who waits comes before who has used most."""
    return set(list(dict.fromkeys(owners))[:_MOST_CALLERS])


def _summed(spent: Iterable[tuple[tuple[str, ...], float]], shown: set[str]) -> dict[tuple[str, str], float]:
    summed: dict[tuple[str, str], float] = defaultdict(float)
    for (owner, kind), value in spent:
        summed[(owner if owner in shown else OTHER, kind)] += value
    return summed
