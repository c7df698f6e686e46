"""Derives the golden tables of the stand-in autopilot from recordings of a real PX4 1.16 (SIH quadrotor).

    python tests/golden/make_px4_golden.py RECORDINGS

RECORDINGS holds `capture.jsonl.xz` (one offboard link: idle, arm, take-off to 5 m, offboard, land, disarm; one JSON
object a line with t, type, fields) and `steps.json.xz` (step responses of two vehicles; rows of t, x, y, z, vx, vy, vz
by the estimate and in truth). Written: px4_streams.json and px4_steps.json beside this file.
"""

import json
import lzma
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).parent
SAMPLE_S = 0.1
SMOOTHING_SAMPLES = 9
STEPS: dict[str, tuple[str, ...]] = {
    "low_drag": (
        "vel N 1 m/s",
        "stop from 1",
        "vel N 3 m/s",
        "stop from 3",
        "acc N 1.0 m/s2",
        "acc N 2.0 m/s2",
        "vel 20",
    ),
    "default_drag": (
        "vel D -1 m/s",
        "vel D 1 m/s",
        "acc U 1",
        "pos N 5 m",
        "pos E 5 m",
        "vel 2 + acc 2 (step, constant)",
        "vel 2 + acc 0",
    ),
}
DRAG_PER_S = {"low_drag": 0.2, "default_drag": 1.0}
OBSERVED = {"vel D": 6, "acc U": 6, "pos N": 1, "pos E": 2}
"""column of the row that responds, by the step's first words; north velocity (4) otherwise"""


def smooth(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Centred moving average, narrower at the ends."""
    half = width // 2
    return np.array([values[max(0, i - half) : i + half + 1].mean() for i in range(len(values))])


def response(times_s: NDArray[np.float64], values: NDArray[np.float64]) -> dict[str, float]:
    """Start, final value (mean of the last second), and the times of 63 % and 90 % between them."""
    smoothed = smooth(values, 5)
    start = float(smoothed[times_s < 0.1].mean())
    final = float(smoothed[times_s > times_s[-1] - 1.0].mean())
    return {
        "start": round(start, 3),
        "final": round(final, 3),
        "t63_s": round(crossing(times_s, smoothed, start, final, 0.632), 3),
        "t90_s": round(crossing(times_s, smoothed, start, final, 0.9), 3),
    }


def crossing(
    times_s: NDArray[np.float64], values: NDArray[np.float64], start: float, final: float, share: float
) -> float:
    """When the values first reach a share of the way, interpolated; NaN: never."""
    way = (values - start) / (final - start)
    for i in range(1, len(way)):
        if way[i] >= share:
            ahead = way[i] - way[i - 1]
            part = 1.0 if ahead <= 0.0 else min(max((share - way[i - 1]) / ahead, 0.0), 1.0)
            return float(times_s[i - 1] + part * (times_s[i] - times_s[i - 1]))
    return float("nan")


def step_table(recordings: Path) -> list[dict[str, Any]]:
    """Every step: response by the estimate, true state at its beginning, the estimator's error during it."""
    with lzma.open(recordings / "steps.json.xz") as file:
        recorded = json.load(file)
    table = []
    for vehicle, names in STEPS.items():
        for name in names:
            entry = recorded[vehicle][name]
            estimate = np.array(entry["est"])
            truth = np.array(entry["truth"])
            times_s = estimate[:, 0] - entry["t0"]
            column = OBSERVED.get(" ".join(name.split()[:2]), 4)
            truth_then = np.array([np.interp(estimate[:, 0], truth[:, 0], truth[:, c]) for c in range(1, 7)]).T
            errors = estimate[:, 1:] - truth_then
            errors = np.array([smooth(errors[:, c], SMOOTHING_SAMPLES) for c in range(6)]).T
            # PX4 flies a fast vertical velocity by the derivative of its altitude, not by its velocity estimate.
            climb_error = np.gradient(smooth(errors[:, 2], SMOOTHING_SAMPLES), times_s)
            grid_s = np.arange(0.0, times_s[-1], SAMPLE_S)
            columns = [*errors.T, climb_error]
            table.append(
                {
                    "name": name,
                    "vehicle": vehicle,
                    "drag_per_s": DRAG_PER_S[vehicle],
                    "column": column,
                    "duration_s": round(float(times_s[-1]), 3),
                    "response": response(times_s, estimate[:, column]),
                    "estimate_at_start": [round(float(v), 3) for v in estimate[0, 1:]],
                    "true_velocity_at_start": [round(float(v), 3) for v in truth[0, 4:]],
                    "curve": [round(float(v), 3) for v in np.interp(grid_s, times_s, estimate[:, column])],
                    "errors": [[round(float(v), 3) for v in np.interp(grid_s, times_s, c)] for c in columns],
                }
            )
    return table


def stream_table(recordings: Path) -> dict[str, Any]:
    """Every message type: how many, how many a second of the autopilot's own time, range of every numeric field."""
    by_type: dict[str, list[dict[str, Any]]] = defaultdict(list)
    boot_ms: list[int] = []
    with lzma.open(recordings / "capture.jsonl.xz", "rt") as lines:
        for line in lines:
            message = json.loads(line)
            by_type[message["type"]].append(message["fields"])
            if message["type"] == "ATTITUDE":
                boot_ms.append(message["fields"]["time_boot_ms"])
    duration_s = (boot_ms[-1] - boot_ms[0]) / 1000.0
    types = {}
    for name, messages in sorted(by_type.items()):
        fields = {}
        for key in messages[0]:
            values = [m[key] for m in messages if isinstance(m[key], int | float)]
            if not values:
                continue
            different = sorted(set(values))
            fields[key] = {"min": different[0], "max": different[-1]}
            if len(different) <= 8 and all(isinstance(v, int) for v in different):
                fields[key]["values"] = different
            if len(values) < len(messages):
                fields[key]["may_be_nan"] = True
        types[name] = {"count": len(messages), "rate_hz": round(len(messages) / duration_s, 2), "fields": fields}
    return {"duration_s": duration_s, "types": types}


def main() -> None:
    """Writes both tables."""
    recordings = Path(sys.argv[1])
    streams = json.dumps(stream_table(recordings), indent=1)
    (HERE / "px4_streams.json").write_text(streams + "\n", encoding="utf-8")
    rows = ",\n".join(json.dumps(row) for row in step_table(recordings))
    (HERE / "px4_steps.json").write_text(f"[\n{rows}\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
