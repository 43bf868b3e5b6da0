"""The table of the commissioning's steps, made from the steps themselves."""

from cell.commissioning.walk import all_steps


def walk_page() -> str:
    """Return the steps as a table: title, first sentence of what each does, name for ``--redo``."""
    rows = ["| step | what it does | `--redo` |", "| --- | --- | --- |"]
    rows += [
        f"| {one.title} | {one.purpose.partition('. ')[0]} | `{one.key}` |" for one in all_steps()
    ]
    return "\n".join(rows)
