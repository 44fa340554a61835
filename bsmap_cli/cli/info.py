"""bsmap info: what is in a log or an artifact."""

import json
from pathlib import Path
from typing import Any

import click

from bsmap_cli.cli.options import existing, input_argument, parameters
from bsmap_cli.params import LogParams


@click.command()
@input_argument("FILE")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
@parameters(LogParams)
def info(file: Path, as_json: bool, log_params: LogParams) -> None:
    """Describe a log (topics, rates, mounts, parts) or an artifact (stage, parameters, inputs, figures)."""
    from bsmap_cli.errors import BadInputError
    from bsmap_cli.io import artifact
    from bsmap_cli.io.completeness import MCAP_MAGIC, is_complete

    existing(file)
    provenance = artifact.read_provenance(file)
    description: dict[str, Any] = {}
    if provenance is not None:
        description = {**provenance.to_dict(), "complete": is_complete(file)}
    if artifact.read_head(file, len(MCAP_MAGIC)) == MCAP_MAGIC:
        description |= _log(file, log_params)
    if not description:
        raise BadInputError(f"{file}: neither an MCAP log nor a file made by bsmap")
    click.echo(json.dumps(description, indent=1) if as_json else "\n".join(_lines(description)))


def _log(file: Path, log_params: LogParams) -> dict[str, Any]:
    from bsmap_cli.io.log import describe_log

    log = describe_log(file, log_params)
    topics = {
        t.topic: {"type": t.type_name, "messages": t.count, "rate": round(t.rate, 3)}
        | ({"part": t.part} if t.part else {})
        for t in log.topics
    }
    mounts = {
        topic: {"xyz": T[:3, 3].round(6).tolist(), "rows": T[:3, :3].round(6).tolist()}
        for topic, T in log.mounts.items()
    }
    span = {"start_ns": log.start_ns, "end_ns": log.end_ns, "seconds": (log.end_ns - log.start_ns) / 1e9}
    return {"time": span, "topics": topics, "mounts": mounts}


def _lines(value: Any, depth: int = 0) -> list[str]:
    """Nested dicts as indented lines."""
    out = []
    for key, item in value.items():
        if isinstance(item, dict):
            out += ["  " * depth + f"{key}:", *_lines(item, depth + 1)]
        else:
            out.append("  " * depth + f"{key}: {item}")
    return out
