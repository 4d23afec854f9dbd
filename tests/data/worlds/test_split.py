"""Which names and seeds belong to train, validation and test."""

from __future__ import annotations

from itertools import islice

from benchmarks.random_worlds.models import PARTS, families, part_of, part_of_world, seeds_of


def test_a_name_always_belongs_to_the_same_part() -> None:
    assert [part_of(name) for name in ("teapot", "chair_pine", "mini_fridge")] == ["train", "test", "train"]


def test_look_alikes_are_of_one_family() -> None:
    family = families(["arm_chair", "arm_chair_nopillow", "arm", "armada", "stool"])
    assert family == {
        "arm_chair": "arm",
        "arm_chair_nopillow": "arm",
        "arm": "arm",
        "armada": "armada",
        "stool": "stool",
    }


def test_every_seed_is_of_one_part_and_each_part_has_its_share() -> None:
    parts = [part_of_world(seed) for seed in range(2000)]
    for part, least in zip(PARTS, (0.4, 0.2, 0.25), strict=True):
        assert parts.count(part) >= least * len(parts)
        assert list(islice(seeds_of(part), 5)) == [seed for seed, own in enumerate(parts) if own == part][:5]
