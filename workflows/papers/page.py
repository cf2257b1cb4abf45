"""The page of all figures and tables, as HTML and Markdown."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import jinja2

import blocksar
from papers.comparison import Exhibit

PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
  body { font: 1rem/1.5 system-ui, sans-serif; color: #1d242d; background: #fff;
         max-width: 68rem; margin: 0 auto; padding: 0 1rem 3rem }
  h1, h2 { line-height: 1.25 }
  h2 { margin-top: 3rem; border-top: 1px solid #d5dae2; padding-top: 1.5rem }
  img { width: 100%; min-width: 40rem; height: auto; display: block }
  .wide { overflow-x: auto; margin: 1rem 0 }
  table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .875rem }
  th, td { padding: .25rem .7rem; border-bottom: 1px solid #e4e7ec; text-align: right; vertical-align: bottom }
  td { white-space: nowrap }
  th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff;
                                   white-space: normal; min-width: 9rem }
  @media (max-width: 40rem) {
    th, td { padding: .2rem .35rem; font-size: .8rem; white-space: normal }
    th:first-child, td:first-child { min-width: 7rem }
  }
  .off { color: #b3202c; font-weight: 600 }
  .quiet { color: #5a6676; font-size: .875rem }
</style>
</head>
<body>
<h1>{{ title }}</h1>
{% for line in preface %}
<p>{{ line }}</p>
{% endfor %}
<div class="wide"><table>
<tr><th>figure or table</th><th>as printed</th><th>seconds</th></tr>
{% for e in exhibits %}
<tr>
  <td><a href="#{{ e.key }}">{{ e.title }}</a></td>
  <td{% if e.failed %} class="off"{% endif %}>{{ e.verdict }}</td>
  <td>{{ "%.0f"|format(e.seconds) }}</td>
</tr>
{% endfor %}
</table></div>
{% for e in exhibits %}
<h2 id="{{ e.key }}">{{ e.title }}</h2>
<p{% if e.failed %} class="off"{% endif %}>{{ e.text }}</p>
{% for picture in e.pictures %}
<div class="wide"><img alt="{{ e.title }}" src="data:image/png;base64,{{ embed(picture) }}"></div>
{% endfor %}
{% for table in e.tables %}
<div class="wide"><table>
<tr>{% for cell in table.header %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for line in table.lines %}
<tr>
{% for cell in line %}
<td{% if cell.off %} class="off"{% endif %}>{{ cell.text }}</td>
{% endfor %}
</tr>
{% endfor %}
</table></div>
{% endfor %}
{% if e.notes %}
<ul>
{% for note in e.notes %}
<li>{{ note }}</li>
{% endfor %}
</ul>
{% endif %}
{% endfor %}
<p class="quiet">{{ origin }}</p>
</body>
</html>
"""

README = """\
# {{ title }}

{% for line in preface %}
{{ line }}

{% endfor %}
| figure or table | as printed | seconds |
|---|---|---|
{% for e in exhibits %}
| [{{ e.title }}](#{{ e.key }}) | {{ e.verdict }} | {{ "%.0f"|format(e.seconds) }} |
{% endfor %}
{% for e in exhibits %}

<a id="{{ e.key }}"></a>

## {{ e.title }}

{{ e.text }}
{% for picture in e.pictures %}

![{{ e.title }}]({{ picture.name }})
{% endfor %}
{% for table in e.tables %}

| {{ table.header|join(" | ") }} |
|{{ "---|" * table.header|length }}
{% for line in table.lines %}
{% for cell in line %}| {{ "**%s**"|format(cell.text) if cell.off else cell.text }} {% endfor %}|
{% endfor %}
{% endfor %}
{% if e.notes %}

{% for note in e.notes %}
- {{ note }}
{% endfor %}
{% endif %}
{% endfor %}

{{ origin }}
"""


def write_page(out: Path, exhibits: Sequence[Exhibit], seconds: float) -> None:
    """Write index.html with embedded pictures, and README.md beside the pictures; each appears complete."""
    values = {
        "title": "The papers' figures and tables, reproduced by blocksar",
        "preface": [
            "All numbers under “ours” were measured in the run that wrote this page: scenes were simulated with exact "
            "ranges, planned, focused and measured. Printed numbers are quoted. Where a paper prints only a curve or a "
            "sentence, its claim is quoted and checked.",
            "“As printed” counts the numbers that agree with the printed ones within a tolerance, and the claims that "
            "hold. The others are in bold, and explained below their table.",
        ],
        "exhibits": exhibits,
        "origin": f"Written by blocksar {blocksar.__version__} in {seconds:.0f} s.",
        "embed": lambda picture: base64.b64encode(picture.read_bytes()).decode(),
    }  # fmt: skip
    for name, template, escaped in (("index.html", PAGE, True), ("README.md", README, False)):
        environment = jinja2.Environment(
            autoescape=escaped, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
        )
        part = out / f"{name}.part"
        part.write_text(environment.from_string(template).render(**values), encoding="utf-8")
        part.replace(out / name)
