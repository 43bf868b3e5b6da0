"""The table of the commissioning's steps, made from the steps themselves."""

from cell.commissioning.walk import all_steps


def walk_page() -> str:
    """Return the steps as a table: title, what each does, and its name for ``--redo``."""
    rows = ["| step | what it finds, writes and moves | `--redo` |", "| --- | --- | --- |"]
    rows += [f"| {step.title} | {step.purpose} | `{step.key}` |" for step in all_steps()]
    return "\n".join(rows)
