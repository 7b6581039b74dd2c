"""The README says what the commands print today, and names every command and scenario."""

import readme
from hybridtrack.catalogue import catalogue
from hybridtrack.cli import app


def test_generated_parts_are_what_the_commands_print_today(shipped):
    folders = readme.finished_runs(shipped)
    text = readme.README.read_text("utf-8")
    assert readme.renewed(text, folders) == text, "run `make ledger`"


def test_every_command_scenario_and_estimator_is_named():
    text = readme.README.read_text("utf-8")
    for command in app.registered_commands:
        name = command.name or command.callback.__name__
        assert f"hybridtrack {name}" in text
    for kind in ("estimators", "analyses", "scenarios"):
        for name in catalogue()[kind]:
            assert f"`{name}`" in text
