"""A host program: it moves, the plugin grasps and says what it was."""

from importlib.metadata import entry_points


def main() -> None:
    (entry,) = entry_points(group="robot_cell.plugins", name="tactile_cell")

    def move(pose):  # your robot's motion; return False to refuse a pose
        print(f"  robot: {pose}")

    # Without a config file: the simulated cell. With one: your ports and limits.
    with entry.load()(config=None, mover=move) as cell:
        for label in ("ball", "box", "cylinder"):
            job = cell.start({"task": "teach", "label": label, "grasps": 6})
            print(f"taught {label} with {cell.result(job, timeout_s=120)} grasps")

        job = cell.start({"task": "identify", "present": "box"})
        while not (status := cell.feedback(job)).outcome.terminal:
            pass  # the host does its own work here
        print(status.progress)

        answer = cell.result(job, timeout_s=60)
        print(f"{answer.label}, {answer.probability:.0%} after {answer.n_grasps} grasp(s)")
        print(f"it feels like: {answer.shape}")  # also where the label is UNKNOWN


if __name__ == "__main__":
    main()
