"""Settings as plain values: what published files look like is read, and nothing is ever made or fetched."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest

from regnf_core.importing.settings.documents import read_hocon, read_yaml
from regnf_core.importing.settings.keys import Tagged, read_json
from tests.core.importing.archives import assert_refused


def yaml(text: str) -> Any:
    return read_yaml("config.yml", text.encode())


def hocon(text: str) -> dict[str, Any]:
    return read_hocon("config.conf", text.encode())


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *(("16", 16), ("-3", -3), ("1.5", 1.5), ("1e-4", 1e-4), ("1.0e-15", 1e-15), (".5", 0.5), ("2_000", 2000)),
        *(("true", True), ("off", False), ("null", None), ("~", None), ("'16'", "16"), ("!!str 16", "16")),
        *(("!!float 16", 16.0), ("2023-05-01_101500", "2023-05-01_101500"), ("017", "017"), ("1:30", "1:30")),
        *(("[1, {a: b}]", [1, {"a": "b"}]), ("9" * 60, "9" * 60)),
    ],
)
def test_yaml_scalars_are_plain(text: str, value: object) -> None:
    found = yaml(f"a: {text}\n")["a"]
    assert found == value
    assert type(found) is type(value)


def test_yaml_infinities_are_read() -> None:
    values = yaml("a: .inf\nb: -.inf\nc: .nan\n")
    assert (values["a"], values["b"]) == (math.inf, -math.inf)
    assert math.isnan(values["c"])


@pytest.mark.parametrize(
    "tag",
    [
        *("!!python/object/apply:os.system", "!!python/object/new:subprocess.Popen", "!!python/name:os.system"),
        *("!!python/module:antigravity", "!!python/object:nerfstudio.configs.base_config.Config", "!anything"),
        "!!timestamp",
    ],
)
def test_a_tag_of_yaml_stays_a_text(tag: str) -> None:
    loaded = set(sys.modules)
    value = yaml(f"a: {tag}\n  b: [touch /tmp/canary]\n" if "object" in tag else f"a: {tag} ''\n")["a"]
    assert isinstance(value, Tagged)
    assert value.tag == tag.replace("!!", "tag:yaml.org,2002:")
    assert set(sys.modules) == loaded


def test_yaml_aliases_share_and_merges_fill_in() -> None:
    values = yaml("a: &x {b: 1, c: 2}\nd: *x\ne: {<<: *x, b: 3}\n")
    assert values["d"] == {"b": 1, "c": 2}
    assert values["e"] == {"b": 3, "c": 2}


def test_keys_of_yaml_that_no_setting_has_are_left_out() -> None:
    assert yaml("? [1, 2]\n: 3\n? !!python/name:a.b ''\n: 4\nc: 5\n") == {"c": 5}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        *(("a: 1\na: 2\n", "SETTINGS_MALFORMED"), ("a: [1\n", "SETTINGS_MALFORMED")),
        *(("a: *b\n", "SETTINGS_MALFORMED"), ("a: &b [*b]\n", "SETTINGS_MALFORMED")),
        *(("a: {<<: 3}\n", "SETTINGS_MALFORMED"), ("--- 1\n--- 2\n", "SETTINGS_MALFORMED")),
        *(("a: \x00\n", "SETTINGS_MALFORMED"), ("{" * 100, "SETTINGS_TOO_LARGE")),
        ("x" * (1 << 20), "SETTINGS_TOO_LARGE"),
        ("a: &a [1, 1, 1]\n" + "".join(f"b{i}: *a\n" for i in range(13_000)), "SETTINGS_TOO_LARGE"),
    ],
)
def test_yaml_that_is_refused(text: str, reason: str) -> None:
    assert_refused(lambda: yaml(text), reason)


def test_hocon_as_published_configurations_write_it() -> None:
    text = """
    # a comment
    general { base_exp_dir = ./exp/CASE/womask  // another
      recording = [
        ./,
        ./models
      ] }
    model.sdf_network.scale = 3
    model { sdf_network { d_out = 257, multires: 6
        skip_in = [4]
        bias = 0.5, weight_norm = True, lr = 5e-4
        "quoted key" = "a \\"text\\" of # words"
      } }
    model.sdf_network { multires = 10 }
    empty {}
    """
    values = hocon(text)
    assert values["general"] == {"base_exp_dir": "./exp/CASE/womask", "recording": ["./", "./models"]}
    assert values["empty"] == {}
    assert values["model"]["sdf_network"] == {
        "scale": 3,
        "d_out": 257,
        "multires": 10,
        "skip_in": [4],
        "bias": 0.5,
        "weight_norm": True,
        "lr": 5e-4,
        "quoted key": 'a "text" of # words',
    }


@pytest.mark.parametrize("text", ["{ a = 1 }", "a = 1", "a : 1\n", "{a=1}\n# the end"])
def test_hocon_s_outer_braces_may_be_left_out(text: str) -> None:
    assert hocon(text) == {"a": 1}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('include "other.conf"', "SETTINGS_UNSAFE"),
        ('a { include required(file("/etc/passwd")) }', "SETTINGS_UNSAFE"),
        *(('include url("http://127.0.0.1/x")', "SETTINGS_UNSAFE"), ("a = ${HOME}", "SETTINGS_UNSAFE")),
        *(("a = ${?HOME}", "SETTINGS_UNSAFE"), ("a = text ${HOME}", "SETTINGS_UNSAFE")),
        *(("a = [1, ${b}]", "SETTINGS_UNSAFE"), ("${a} = 1", "SETTINGS_UNSAFE")),
        *(("a = {b = 1} {c = 2}", "SETTINGS_MALFORMED"), ("a = [1] [2]", "SETTINGS_MALFORMED")),
        *(("a += 1", "SETTINGS_MALFORMED"), ("a = [1, 2", "SETTINGS_MALFORMED"), ("a { b = 1", "SETTINGS_MALFORMED")),
        *(("a = 1 }", "SETTINGS_MALFORMED"), ("a", "SETTINGS_MALFORMED"), ('a = "open', "SETTINGS_MALFORMED")),
        *(("a = " + "[" * 100, "SETTINGS_TOO_LARGE"), (".".join("a" * 100) + " = 1", "SETTINGS_TOO_LARGE")),
        *(("a = [" + "1," * 100_000 + "]", "SETTINGS_TOO_LARGE"), ("a = 1\n" * 100_000, "SETTINGS_TOO_LARGE")),
    ],
)
def test_hocon_that_is_refused(text: str, reason: str) -> None:
    assert_refused(lambda: hocon(text), reason)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        *((b"{", "SETTINGS_MALFORMED"), (b'{"a": NaN}', "SETTINGS_MALFORMED")),
        *((b'{"a": {"b": 1, "b": 1}}', "SETTINGS_MALFORMED"), (b"9" * 5000, "SETTINGS_MALFORMED")),
        *((b'{"a": 1' + b"0" * 309 + b"}", "SETTINGS_MALFORMED"), (b"\xff", "SETTINGS_MALFORMED")),
        *((b"[" * 200 + b"]" * 200, "SETTINGS_TOO_LARGE"), (b"[" + b"1," * 500_000 + b"1]", "SETTINGS_TOO_LARGE")),
        (b" " * (9 << 20), "SETTINGS_TOO_LARGE"),
    ],
)
def test_json_that_is_refused(text: bytes, reason: str) -> None:
    assert_refused(lambda: read_json("specs.json", text), reason)


def test_brackets_in_a_text_of_json_are_no_depth() -> None:
    assert read_json("specs.json", b'{"a": "' + b"[" * 300 + b'\\""}') == {"a": "[" * 300 + '"'}
