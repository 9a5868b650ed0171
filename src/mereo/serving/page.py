"""The page ``/docs``: what can be asked, written out of the OpenAPI description, without anything from another host."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h2 { margin-top: 2.5rem; } code, pre { background: #f3f4f6; padding: .1rem .3rem; border-radius: 4px; }
table { border-collapse: collapse; width: 100%; } td, th { text-align: left; padding: .25rem .75rem .25rem 0;
border-bottom: 1px solid #ddd; vertical-align: top; }
@media (prefers-color-scheme: dark) { body { background: #16191f; color: #ddd; } code { background: #2a2f38; } }
"""


def docs_page(description: Mapping[str, Any]) -> str:
    """HTML of an OpenAPI description: every address with its parameters and answers."""
    info = description["info"]
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width, initial-scale=1'><title>{escape(info['title'])}</title>",
        f"<style>{STYLE}</style><h1>{escape(info['title'])}</h1><p>{escape(info.get('description', ''))}</p>",
        "<p>For programs: <a href=/openapi.json>openapi.json</a>.</p>",
    ]
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            parts += _operation(method.upper(), path, operation)
    return "\n".join(parts)


def _operation(method: str, path: str, operation: Mapping[str, Any]) -> Iterator[str]:
    yield f"<h2><code>{method} {escape(path)}</code></h2><p>{escape(operation.get('description', ''))}</p>"
    body = operation.get("requestBody", {}).get("content", {})
    if body:
        yield f"<p>Body: {', '.join(f'<code>{escape(media)}</code>' for media in body)}</p>"
    rows = [
        (parameter["name"], _kind(parameter.get("schema", {})), parameter.get("description", ""))
        for parameter in operation.get("parameters", ())
    ]
    if rows:
        yield _table(("parameter", "value", "meaning"), rows)
    answers = operation.get("responses", {})
    yield _table(
        ("answer", "", "when"),
        [
            (code, ", ".join(found.get("content", {})) or "application/json", found.get("description", ""))
            for code, found in answers.items()
        ],
    )


def _kind(schema: Mapping[str, Any]) -> str:
    """Words for a parameter's values, with the default."""
    choices = [one for one in schema.get("anyOf", (schema,)) if one.get("type") != "null"]
    words = [
        " or ".join(one["enum"]) if "enum" in one else "numbers" if one.get("type") == "array" else str(one.get("type"))
        for one in choices
    ]
    default = schema.get("default")
    return ", ".join(words) + ("" if default is None else f" (default: {str(default).lower()})")


def _table(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    head = "".join(f"<th>{escape(word)}" for word in heads)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}' for cell in row)}" for row in rows)
    return f"<table><tr>{head}{body}</table>"
