"""Settings as plain values: what published files look like is read, and nothing is ever made or fetched."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
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


def test_yaml_aliases_share_merges_fill_in_and_odd_keys_are_left_out() -> None:
    values = yaml("a: &x {b: 1, c: 2}\nd: *x\ne: {<<: *x, b: 3}\ni: [.inf, -.inf, .nan]\n")
    assert (values["d"], values["e"]) == ({"b": 1, "c": 2}, {"b": 3, "c": 2})
    np.testing.assert_array_equal(values["i"], [np.inf, -np.inf, np.nan])
    assert yaml("? [1, 2]\n: 3\n? !!python/name:a.b ''\n: 4\nc: 5\n") == {"c": 5}


YAML = {
    "SETTINGS_MALFORMED": [
        *("a: 1\na: 2\n", "a: [1\n", "a: *b\n", "a: &b [*b]\n", "a: {<<: 3}\n", "--- 1\n--- 2\n", "a: \x00\n"),
    ],
    "SETTINGS_TOO_LARGE": [
        *("{" * 100, "x" * (1 << 20), "a: &a [1, 1, 1]\n" + "".join(f"b{i}: *a\n" for i in range(13_000))),
    ],
}


@pytest.mark.parametrize(("reason", "texts"), YAML.items())
def test_yaml_that_is_refused(reason: str, texts: list[str]) -> None:
    for text in texts:
        assert_refused(lambda text=text: yaml(text), reason)


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


HOCON = {
    "SETTINGS_UNSAFE": [
        *('include "other.conf"', 'a { include required(file("/etc/passwd")) }', 'include url("http://127.0.0.1/x")'),
        *("a = ${HOME}", "a = ${?HOME}", "a = text ${HOME}", "a = [1, ${b}]", "${a} = 1"),
    ],
    "SETTINGS_MALFORMED": [
        *("a = {b = 1} {c = 2}", "a = [1] [2]", "a += 1", "a = [1, 2", "a { b = 1", "a = 1 }", "a", 'a = "open'),
    ],
    "SETTINGS_TOO_LARGE": [
        *("a = " + "[" * 100, ".".join("a" * 100) + " = 1", "a = [" + "1," * 100_000 + "]", "a = 1\n" * 100_000),
    ],
}


@pytest.mark.parametrize(("reason", "texts"), HOCON.items())
def test_hocon_that_is_refused(reason: str, texts: list[str]) -> None:
    for text in texts:
        assert_refused(lambda text=text: hocon(text), reason)


JSON = {
    "SETTINGS_MALFORMED": [
        *(b"{", b'{"a": NaN}', b'{"a": {"b": 1, "b": 1}}', b"9" * 5000, b'{"a": 1' + b"0" * 309 + b"}", b"\xff"),
    ],
    "SETTINGS_TOO_LARGE": [b"[" * 200 + b"]" * 200, b"[" + b"1," * 500_000 + b"1]", b" " * (9 << 20)],
}


@pytest.mark.parametrize(("reason", "texts"), JSON.items())
def test_json_that_is_refused(reason: str, texts: list[bytes]) -> None:
    for text in texts:
        assert_refused(lambda text=text: read_json("specs.json", text), reason)


def test_brackets_in_a_text_of_json_are_no_depth() -> None:
    assert read_json("specs.json", b'{"a": "' + b"[" * 300 + b'\\""}') == {"a": "[" * 300 + '"'}
