"""Board and alerts name metrics that exist, and every alert has its section in the runbook."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client import generate_latest

from regnf_service.metrics import Metrics
from regnf_state.records import FieldRecord, JobRecord
from regnf_state.redis.client import connect
from regnf_state.redis.counters import count
from regnf_state.redis.webhook_outbox import Delivery, Message, RedisOutbox
from regnf_state.settings import Settings
from tests.redis_server import private_redis
from tests.stores import services_over

ROOT = Path(__file__).resolve().parents[2]
RULES: list[dict[str, Any]] = yaml.safe_load((ROOT / "deploy/prometheus/regnf.rules.yaml").read_text())["groups"][0][
    "rules"
]
BOARD: dict[str, Any] = json.loads((ROOT / "deploy/grafana/regnf.json").read_text())
RUNBOOK = (ROOT / "docs/runbook.md").read_text()
QUERIES = [rule["expr"] for rule in RULES] + [one["expr"] for panel in BOARD["panels"] for one in panel["targets"]]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Every metric of a service in which everything has happened once, with its labels."""
    with private_redis() as url, connect(url) as redis:
        settings = Settings(state_dir=tmp_path_factory.mktemp("state"))
        services = services_over(redis, settings)
        store = services.records
        for name in ("ended", "waits"):
            store.create_job(JobRecord(name, "registration", "accepted", {}, {}, store.now(), store.now()), 10)
        store.update_job("ended", 1, status="running", phase="loading")
        store.update_job("ended", 1, status="successful", verdict="registered")
        store.create_field(FieldRecord("a" * 64, "validating", 1, store.now(), store.now()))
        store.update_field("a" * 64, state="ready")
        for number in range(2):
            services.queue.enqueue_registration(f"j{number}", 1)
        count(redis, "queue_payloads_refused", "regnf")
        count(redis, "jobs_evicted")
        count(redis, "records_unreadable", "job")
        RedisOutbox(redis).settle(Message("ended", 1, 0, "anonymous hooks.example"), Delivery("delivered"))
        metrics = Metrics(services)
        metrics.requests.labels("GET", "/", "200").inc()
        metrics.seconds.labels("/").observe(1)
        metrics.received.labels("/").inc()
        metrics.quota_refusals.labels("QUOTA_ACTIVE_JOBS").inc()
        text = generate_latest(metrics.registry).decode()
    found: dict[str, set[str]] = {}
    for line in text.splitlines():
        match = re.match(r"(\w+)(?:\{(.*)\})? ", line)
        if match:
            found.setdefault(match[1], set()).update(re.findall(r'(\w+)="', match[2] or ""))
    return found


@pytest.mark.parametrize("query", QUERIES)
def test_every_metric_named_exists_with_its_labels(query: str, shown: dict[str, set[str]]) -> None:
    names = set(re.findall(r"\b(?:regnf|process)_\w+", query))
    assert names <= shown.keys()
    held = set().union(*(shown[name] for name in names)) | {"instance", "job"}
    grouped = re.findall(r"\b(?:by|on) ?\(([^)]*)\)", query)
    selected = re.findall(r"(\w+) ?(?:=~|!=|=)\"", query)
    assert {label.strip() for group in grouped for label in group.split(",")} | set(selected) <= held
    assert query.count("(") == query.count(")")
    assert names or query.startswith("up{")


def test_every_metric_is_on_the_board(shown: dict[str, set[str]]) -> None:
    ours = {name for name in shown if name.startswith("regnf_")}
    bare = {re.sub(r"_(bucket|sum|count|created|total)$", "", name) for name in ours}
    on_board = {
        re.sub(r"_(bucket|count|total)$", "", name) for query in QUERIES for name in re.findall(r"\bregnf_\w+", query)
    }
    assert bare <= on_board


def test_every_alert_has_its_section_and_every_section_its_alert() -> None:
    sections = set(re.findall(r"^## (\w+)$", RUNBOOK, re.MULTILINE)) - {"Scraping"}
    assert {rule["alert"] for rule in RULES} == sections
    for rule in RULES:
        assert rule["labels"]["severity"] in ("page", "ticket")
        assert rule["annotations"]["summary"]


def test_what_the_runbook_names_exists(shown: dict[str, set[str]]) -> None:
    named = set(re.findall(r"`(regnf_\w+)`", RUNBOOK))
    assert named - shown.keys() <= {name.removesuffix("_bucket") for name in shown}
    settings = {f"REGNF_{name.upper()}" for name in Settings.model_fields}
    assert set(re.findall(r"REGNF_[A-Z_]+[A-Z]", RUNBOOK)) <= settings


def test_panels_do_not_overlap() -> None:
    places = [tuple(panel["gridPos"].values()) for panel in BOARD["panels"]]
    assert len(set(places)) == len(places) == len({panel["id"] for panel in BOARD["panels"]})
    assert all(panel["gridPos"]["x"] + panel["gridPos"]["w"] <= 24 for panel in BOARD["panels"])
