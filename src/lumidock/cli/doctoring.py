"""`lumidock doctor` and `lumidock config`."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer

from lumidock.app.settings_text import as_yaml
from lumidock.cli.shared import AsJson, ConfigOption, app, example
from lumidock.config import Config, load_config

config = typer.Typer(help="Show the settings.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(config, name="config")


@app.command("doctor", epilog=example("lumidock doctor", "lumidock doctor --json"))
def _doctor(as_json: AsJson = False) -> None:
    """Check this machine; exit code 1 when something keeps lumidock from working."""
    from lumidock.app.doctor import examine

    findings = examine()
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
    else:
        for finding in findings:
            print(f"{finding.mark:5} {finding.what:12} {finding.text}")
    if any(finding.mark == "bad" for finding in findings):
        raise typer.Exit(1)


@config.command("dump", epilog=example("lumidock config dump > all.yaml", "lumidock config dump --config mine.yaml"))
def _dump(changes: ConfigOption = None) -> None:
    """Print every setting with its unit and meaning, and your changes, as a file for --config."""
    settings = load_config(changes) if changes else Config()
    print(as_yaml(settings), end="")


@config.command("schema", epilog=example("lumidock config schema > lumidock.schema.json"))
def _schema() -> None:
    """Print the JSON schema of a file for --config."""
    print(json.dumps(Config.model_json_schema(), indent=1))
