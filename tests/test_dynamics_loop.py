"""The torque level on a robot with motors in MuJoCo: distances, torques and stops as they turn out, not as planned."""

import numpy as np
import pytest

from qpavoid import load_scenario, simulate
from qpavoid.config import Payload, PlantSettings

pytest.importorskip("mujoco")

LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
MOTORS = {"armature": 0.1, "friction": 0.3, "damping": 0.5}
"""Of all runs; the controller does not know of the friction."""
D1 = 0.03


def play(name, fields=(), **plant):
    """Run a scenario on motors, and print its figures; return its log, the least distance [m] and its metrics."""
    log = simulate(load_scenario(name, list(fields)), plant=PlantSettings(**MOTORS, **plant))
    assert log.meta["completed"]
    closest, figures = float(log.body_distance[:, 1:].min()), log.metrics()
    print(
        f"{name} {' '.join(fields)} {plant}: "
        f"closest {1e3 * closest:.1f} mm, end {1e3 * figures['final_error']:.1f} mm, "
        f"Σ|Δτ| {figures['torque']['jitter']:.0f} Nm/s, torque {100 * figures['torque']['share']:.0f} %, "
        f"outside limits {1e3 * outside(log):.1f} mrad, {figures['status_counts']}"
    )
    return log, closest, figures


def outside(log):
    """By how much a joint passes a position limit at the most [rad]."""
    lower, upper = np.array([limits[1:] for limits in log.meta["position_limits"]]).T
    return float(np.maximum(log.q - upper, lower - log.q).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "plant",
    [{}, {"mass_scale": 0.8}, {"mass_scale": 1.2}, {"payload": Payload(frame="panda_hand_tcp", mass=1.5)}],
    ids=["exact", "lighter", "heavier", "payload"],
)
def test_crossing_ball_is_avoided_whatever_the_masses(plant):
    _, closest, figures = play("panda_torque", **plant)
    assert closest >= D1 - 0.5e-3  # wrong gravity costs its acceleration over α2 ξ
    assert figures["final_error"] < 0.010
    assert figures["torque"]["jitter"] < 250.0


@pytest.mark.slow
def test_delay_of_the_motors_makes_no_torque_chatter():
    _, closest, figures = play("panda_torque", delay=2e-3)
    assert closest >= D1 - 0.5e-3
    assert figures["torque"]["jitter"] < 500.0


@pytest.mark.slow
def test_noise_and_delay_cost_little_distance():
    _, closest, _ = play(
        "panda_torque", ["dynamics.tracking_rate=40", "dynamics.row_rate=50"], delay=2e-3, velocity_noise=5e-3,
        position_noise=5e-4,
    )  # fmt: skip
    assert closest >= D1 - 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [1.0, 0.7])
def test_dive_at_a_table_brakes_in_time(fraction):
    """20 % of the masses are unknown; where motors are weaker, gravity comes to take nearly all of their torques."""
    log, closest, figures = play("panda_dive", [f"dynamics.torque_limits={fraction}"], mass_scale=1.2)
    assert closest >= D1 - 1e-3
    assert (np.abs(log.torque) <= fraction * LIMITS + 1e-9).all()
    assert outside(log) < 1e-3
    assert figures["torque"]["jitter"] < (2000.0 if fraction == 1.0 else 5000.0)  # holding rows and braking meet
    assert fraction < 1.0 or figures["severity_counts"]["ALARM"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(("d2", "masses"), [(0.1, 1.2), (0.06, 1.0)])
def test_rows_that_come_too_late_are_braked_for_ahead(d2, masses):
    """With a d2 too short to brake in, rows alone let the dive end in the table; the look-ahead keeps it off."""
    _, closest, figures = play("panda_dive", [f"avoidance.d2={d2}"], mass_scale=masses)
    assert closest >= D1 - 1e-3 and figures["status_counts"]["STOPPED"] == 0
    _, closest, _ = play("panda_dive", [f"avoidance.d2={d2}", "avoidance.look_ahead=false"], mass_scale=masses)
    assert closest < 0.0


@pytest.mark.slow
def test_without_holding_rows_an_arm_of_weak_motors_relaxes_again_and_again():
    """Motors of 70 %, 20 % of the masses unknown: what braking needs is no longer there once gravity takes it."""
    weak = "dynamics.torque_limits=0.7"
    figures = play("panda_dive", [weak], mass_scale=1.2)[2]
    without = play("panda_dive", [weak, "dynamics.holding_fraction=null"], mass_scale=1.2)[2]
    assert without["status_counts"]["RELAXED"] > 5 * figures["status_counts"]["RELAXED"]
    assert without["torque"]["jitter"] > 1.5 * figures["torque"]["jitter"]


@pytest.mark.slow
def test_panda_with_jerk_limits_avoids_the_ball():
    log, closest, figures = play("panda_torque", ["limits.jerk=3000"])
    assert closest >= D1 - 0.5e-3
    assert figures["final_error"] < 0.010
    changes = np.abs(np.diff(np.diff(log.v, axis=0), axis=0)) / log.meta["config"]["dt"] ** 2
    assert np.quantile(changes, 0.9) < 3000.0


@pytest.mark.parametrize("solver", ["qp", "eq10"])
def test_starved_of_torque_it_stops_or_relaxes_by_name(solver):
    fields = ["dynamics.torque_limits=0.15", "duration=0.3", f"solver={solver}"]
    log, _, figures = play("panda_torque", fields)
    assert figures["status_counts"]["SOLVED"] < 30
    assert np.isfinite(log.torque).all()
    assert (np.abs(log.torque) <= 0.15 * LIMITS + 1e-9).all()
    named = {reason["kind"] for _, _, reasons in figures["events"] for reason in reasons}
    assert named & {"TORQUE_SATURATED", "AT_TORQUE_LIMIT", "HOLDING_RELAXED"}
