"""A host program: it moves, the plugin grasps and returns what was held."""

import time
from importlib.metadata import entry_points


def move(pose):  # your robot's motion; return False to refuse a pose
    print(f"  robot: {pose}")


def main() -> None:
    (entry,) = entry_points(group="robot_cell.plugins", name="tactile_cell")
    # Without a config file: the simulated cell. With one: your ports and limits.
    with entry.load()(config=None, mover=move) as cell:
        for seed, label in enumerate(("ball", "box", "cylinder")):  # other poses for each object
            job = cell.start({"task": "teach", "label": label, "grasps": 6, "seed": seed})
            print(f"taught {label} with {cell.result(job, timeout_s=120)} grasps")

        job = cell.start({"task": "identify", "present": "box", "keep": "always", "seed": 100})
        while not cell.feedback(job).outcome.terminal:
            time.sleep(0.05)  # the host does its own work here
        answer = cell.result(job, timeout_s=1)
        print(f"{answer.label}, {answer.probability:.0%} after {answer.n_grasps} grasp(s)")
        print(f"measured shape: {answer.shape}")  # also where the label is UNKNOWN
        print(f"  robot: to the bin of {answer.label}, the part in the grip: {answer.in_grip}")
        cell.release()  # there; only this lets go


if __name__ == "__main__":
    main()
