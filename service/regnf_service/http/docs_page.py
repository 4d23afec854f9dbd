"""GET /docs: the contract as one page of plain HTML, without scripts and without anything from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html import escape
from typing import Any

from regnf_state.reasons import REASONS

_STYLE = """
:root{color-scheme:light dark;--line:light-dark(#ddd,#333);--soft:light-dark(#f5f5f5,#1b1b1b)}
body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}
code,pre{font-family:ui-monospace,monospace;font-size:.9em}pre{background:var(--soft);padding:.8rem;overflow:auto}
section{border-top:1px solid var(--line);margin-top:1.5rem}h3 code{font-size:1em}
b.m{display:inline-block;min-width:4.5rem}
table{border-collapse:collapse;width:100%}td,th{border-top:1px solid var(--line);padding:.3rem .6rem;text-align:left;
vertical-align:top}:target{background:var(--soft)}
"""
_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
STYLE_POLICY = (
    f"default-src 'none'; style-src 'sha256-{_HASH}'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def render_docs(contract: dict[str, Any]) -> str:
    """The whole page."""
    operations = [
        _operation(method, path, operation)
        for path, methods in contract["paths"].items()
        for method, operation in methods.items()
    ]
    schemas = [_schema(name, schema) for name, schema in contract["components"]["schemas"].items()]
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width,initial-scale=1">',
            f"<title>regnf {escape(contract['info']['version'])}</title><style>{_STYLE}</style></head><body>",
            f"<h1>regnf {escape(contract['info']['version'])}</h1>{_text(contract['info']['description'])}",
            '<p>The same for programs: <a href="/openapi.yaml">openapi.yaml</a>.</p>',
            "<h2>Addresses</h2>",
            *operations,
            '<h2 id="reasons">Reasons</h2>',
            _reasons(),
            '<h2 id="schemas">Schemas</h2>',
            *schemas,
            "</body></html>",
        ]
    )


def _text(text: str) -> str:
    """Paragraphs, with `code` marked."""
    marked = re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text.strip()))
    return "".join(f"<p>{paragraph}</p>" for paragraph in marked.split("\n\n"))


def _operation(method: str, path: str, operation: dict[str, Any]) -> str:
    parts = [f"<section><h3><b class=m>{method.upper()}</b> <code>{escape(path)}</code></h3>"]
    parts.append(_text(operation["summary"] + ". " + operation.get("description", "")))
    rows = [
        (f"<code>{escape(item['name'])}</code>", escape(item["in"]), _text(item.get("description", "")))
        for item in operation.get("parameters", [])
    ]
    parts.append(_table(("parameter", "in", ""), rows))
    for kind, content in operation.get("requestBody", {}).get("content", {}).items():
        parts.append(f"<p>Body <code>{escape(kind)}</code>: {_type(content.get('schema', {}))}</p>")
        for example in content.get("examples", {}).values():
            parts.append(_text(example["summary"]) + f"<pre>{escape(json.dumps(example['value'], indent=1))}</pre>")
    rows = [
        (
            f"<code>{status}</code>",
            _text(answer["description"]),
            _bodies(answer.get("content", {})),
        )
        for status, answer in operation["responses"].items()
    ]
    parts.append(_table(("status", "", "body"), rows))
    return "".join(parts) + "</section>"


def _bodies(content: dict[str, Any]) -> str:
    return ", ".join(f"<code>{escape(kind)}</code> {_type(body.get('schema', {}))}" for kind, body in content.items())


def _type(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        name = escape(schema["$ref"].rpartition("/")[2])
        return f'<a href="#{name}">{name}</a>'
    return " or ".join(_type(one) for one in schema.get("anyOf", []))


def _schema(name: str, schema: dict[str, Any]) -> str:
    text = escape(json.dumps(schema, indent=1))
    linked = re.sub(r"#/components/schemas/(\w+)", r'<a href="#\1">\1</a>', text)
    return f'<section id="{escape(name)}"><h3><code>{escape(name)}</code></h3><pre>{linked}</pre></section>'


def _reasons() -> str:
    rows = [
        f'<tr id="{name}"><td><code>{name}</code></td><td>{reason.status}</td><td>{_text(reason.meaning)}</td></tr>'
        for name, reason in REASONS.items()
    ]
    return f"<table><tr><th>reason</th><th>status</th><th></th></tr>{''.join(rows)}</table>"


def _table(heads: tuple[str, ...], rows: list[tuple[str, str, str]]) -> str:
    if not rows:
        return ""
    top = "".join(f"<th>{head}</th>" for head in heads)
    lines = ["".join(f"<td>{cell}</td>" for cell in row) for row in rows]
    return f"<table><tr>{top}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"
