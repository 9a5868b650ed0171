"""The page ``/docs``: the requests, written out of the OpenAPI description, without anything from another host."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h2 { margin: 3rem 0 .5rem; font-size: 1.25rem; overflow-wrap: anywhere; }
code { background: #8883; padding: .1rem .3rem; border-radius: 4px; }
table { border-collapse: collapse; width: 100%; margin: 0 0 1.5rem; }
td, th { text-align: left; padding: .3rem .75rem .3rem 0; border-bottom: 1px solid #8884; vertical-align: top; }
td + td { overflow-wrap: anywhere; }
"""


def docs_page(description: Mapping[str, Any]) -> str:
    """HTML of an OpenAPI description: every address with its parameters and answers."""
    info = description["info"]
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        '<meta name=viewport content="width=device-width, initial-scale=1">',
        f"<title>{escape(info['title'])}</title><style>{STYLE}</style>",
        f"<h1>{escape(info['title'])}</h1><p>{_words(info.get('description', ''))}</p>",
        "<p>For programs: <a href=/openapi.json>openapi.json</a>.</p>",
    ]
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            parts += _operation(method.upper(), path, operation)
    return "\n".join(parts)


def _operation(method: str, path: str, operation: Mapping[str, Any]) -> Iterator[str]:
    yield f"<h2><code>{method} {escape(path)}</code></h2><p>{_words(operation.get('description', ''))}</p>"
    body = operation.get("requestBody", {}).get("content", {})
    if body:
        yield f"<p>Body: {', '.join(f'<code>{escape(media)}</code>' for media in body)}</p>"
    form = body.get("multipart/form-data", {}).get("schema", {})
    if form:
        parts = [f"<code>{escape(name)}</code>{_needed(name, form)}" for name in form["properties"]]
        yield f"<p>Parts of a form: {', '.join(parts)}</p>"
    rows = [
        (parameter["name"], _kind(parameter.get("schema", {})), parameter.get("description", ""))
        for parameter in operation.get("parameters", ())
    ]
    if rows:
        yield _table(("parameter", "value", "meaning"), rows)
    answers = operation.get("responses", {})
    yield _table(
        ("answer", "kind", "when"),
        [
            (code, ", ".join(response.get("content", {})) or "application/json", response.get("description", ""))
            for code, response in answers.items()
        ],
    )


def _needed(name: str, form: Mapping[str, Any]) -> str:
    """What is said behind a part of a form that may be left out."""
    return "" if name in form.get("required", ()) else " (where there is one)"


def _words(text: str) -> str:
    """Text in HTML, what lies between backticks as code."""
    parts = escape(text).split("`")
    return "".join(f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts))


def _kind(schema: Mapping[str, Any]) -> str:
    """Words for a parameter's values, with the default."""
    choices = [kind for kind in schema.get("anyOf", (schema,)) if kind.get("type") != "null"]
    words = [
        " or ".join(kind["enum"])
        if "enum" in kind
        else "numbers"
        if kind.get("type") == "array"
        else str(kind.get("type"))
        for kind in choices
    ]
    default = schema.get("default")
    return ", ".join(words) + ("" if default is None else f" (default: {str(default).lower()})")


def _table(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    head = "".join(f"<th>{escape(word)}" for word in heads)
    body = "".join(f"<tr>{''.join(f'<td>{_words(cell)}' for cell in row)}" for row in rows)
    return f"<table><tr>{head}{body}</table>"
