"""Step response, droop and creep in the hand with each choice of ``actuator``, on native MuJoCo.

python tools/servo_response.py docs/images/servos.png
"""

import argparse
from contextlib import closing
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np

from mjstack.config import load_config
from mjstack.episodes.stage import Stage
from mjstack.scene import build_model

STEP = np.radians(10.0)
PERIOD = 0.0005  # s


def respond(model: mujoco.MjModel, start: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Angle of the shoulder pan after a step [rad]: the scene's, and that of its figures alone."""
    data = mujoco.MjData(model)
    data.qpos[: len(start)] = data.ctrl[:] = start
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    data.ctrl[0] += STEP
    angles = np.zeros((2, steps))
    angle, speed = 0.0, 0.0
    effort, friction = model.actuator_forcerange[0, 1], model.dof_frictionloss[0]
    for step in range(steps):
        mujoco.mj_step(model, data)
        servo = model.actuator_gainprm[0, 0] * (STEP - angle) + model.actuator_biasprm[0, 2] * speed
        torque = np.clip(servo, -effort, effort) - model.dof_damping[0] * speed
        stop = torque + inertia[0, 0] * speed / PERIOD  # what would stop it in this step
        speed += PERIOD * (torque - np.clip(stop, -friction, friction)) / inertia[0, 0]
        angle += PERIOD * speed
        angles[:, step] = data.qpos[0] - start[0], angle
    return angles[0], angles[1]


def hang(model: mujoco.MjModel, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """Droop where gravity pulls most, and the least and most that the figures allow [deg]."""
    data = mujoco.MjData(model)
    best, most = np.zeros(joints), 0.0
    for pose in np.random.default_rng(0).uniform(*model.actuator_ctrlrange.T, (5000, joints)):
        data.qpos[:joints] = pose
        mujoco.mj_forward(model, data)
        clear = data.xpos[2 : joints + 2, 2].min() > 0.1  # m above the table
        if clear and abs(data.qfrc_bias[1]) > most:
            best, most = pose, abs(data.qfrc_bias[1])
    mujoco.mj_resetData(model, data)
    data.qpos[:joints] = data.ctrl[:] = best
    mujoco.mj_step(model, data, int(3.0 / PERIOD))
    torque = np.abs(data.qfrc_bias[:joints])
    least = np.maximum(torque - model.dof_frictionloss[:joints], 0.0)
    bounds = np.stack((least, torque)) / model.actuator_gainprm[:, 0]
    return np.degrees(np.abs(data.qpos[:joints] - best)), np.degrees(bounds)


def creep(servo: str, worlds: int = 8, seconds: float = 5.0) -> np.ndarray:
    """Speed at which the red cube slips through the hand that holds it up [um/s], by world."""
    cfg = load_config([f"actuator={servo}", "controller=closed_loop", "reset=jitter", "sim=native"])
    stage = Stage(cfg)
    with closing(stage.batch_simulation(worlds)) as sim:
        env = stage.start(sim, cfg.reset)
        driver = stage.driver(env)
        for _ in range(stage.phase("lift_red").stop):
            targets = driver.command().clone()
            env.step(targets)
        site, address = env.index.grasp_sites[0], env.index.object_qpos[0]
        places = np.zeros((2, worlds, 3))  # of the cube, seen from the hand
        for place, wait in zip(places, (1.0, seconds), strict=True):
            for _ in range(round(wait * cfg.task.control_hz)):
                env.step(targets)
            apart = (sim.qpos[:, address : address + 3] - sim.site_xpos[:, site]).numpy()
            hands = sim.xquat[:, sim.model.site_bodyid[site]].numpy() * [1, -1, -1, -1]
            for world in range(worlds):
                mujoco.mju_rotVecQuat(place[world], apart[world], hands[world])
        assert sim.qpos[:, address + 2].min() > 0.06, "a world has dropped its cube"
        return 1e6 * np.linalg.norm(places[1] - places[0], axis=1) / seconds


def main() -> None:
    """Measure, print a table in Markdown, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.0), layout="constrained")
    time = PERIOD * np.arange(1, int(0.6 / PERIOD) + 1)
    for number, name in enumerate(("default", "gtc_berlin", "workshop")):
        cfg = load_config([f"actuator={name}"])
        model = build_model(cfg)
        model.opt.timestep = PERIOD
        angles, published = np.degrees(respond(model, np.array(cfg.robot.start), len(time)))
        left.plot(time, angles, color=f"C{number}", label=name)
        left.plot(time, published, "k:", lw=1.2)
        joints = cfg.robot.joints
        droop, bounds = (values[..., 1:4] for values in hang(model, len(joints)))
        x = np.arange(3) + 0.25 * (number - 1)
        right.bar(x, droop, 0.22, color=f"C{number}")
        right.vlines(x, *bounds, "k", lw=3)
        slip = creep(name)
        cells = [f"`{name}`", f"{1e3 * time[np.argmax(angles > 9.0)]:.0f} ms"]
        cells += [f"{max(angles.max() - 10.0, 0.0):.1f}", " / ".join(f"{v:.2f}" for v in droop)]
        cells += [" / ".join(f"{low:.2f} to {high:.2f}" for low, high in bounds.T)]
        print(f"| {' | '.join(cells)} | {np.median(slip):.0f} | {slip.max():.0f} |", flush=True)
    left.set(xlabel="s", ylabel="degrees", title="shoulder pan after a step of 10 degrees")
    left.legend(loc="lower right")
    right.axhspan(1.8, 2.6, color="0.9", zorder=0, label="real arms under load")  # SO-ARM100#134
    right.set_xticks(range(3), joints[1:4])  # those at which gravity pulls
    right.set(ylabel="degrees", title="droop of the stretched arm")
    right.legend(loc="upper right")
    figure.savefig(options.picture, dpi=100)


if __name__ == "__main__":
    main()
