"""Drive native MuJoCo by an exported policy, without mjstack: python policy_native.py FOLDER"""

import json
import sys

import mujoco
import numpy as np
import onnxruntime


def play(folder: str, steps: int) -> list[np.ndarray]:
    """Joint targets of every control step, from home and the objects' nominal places."""
    session = onnxruntime.InferenceSession(f"{folder}/policy.onnx")
    facts = {k: json.loads(v) for k, v in session.get_modelmeta().custom_metadata_map.items()}
    model = mujoco.MjModel.from_binary_path(f"{folder}/model.mjb")
    data = mujoco.MjData(model)
    robot, execute = facts["robot"], facts["action"]["execute"]
    boxes = [data.body(name) for name, o in facts["objects"].items() if o["shape"] == "box"]
    data.qpos[robot["qpos"]] = data.ctrl[robot["ctrl"]] = robot["home"]
    assert facts["action"]["kind"] == "absolute joint targets"
    past, targets = {}, [np.zeros(len(robot["joints"]))]

    def grasp(object: str, height: float = 0.0) -> np.ndarray:
        grasp_point = np.mean([data.site(name).xpos for name in robot["grasp_sites"]], axis=0)
        return data.body(object).xpos - grasp_point + np.array([0, 0, height])

    def headings() -> np.ndarray:
        turns = [4 * np.arctan2(body.xmat[3], body.xmat[0]) for body in boxes]
        return np.ravel([(np.cos(turn), np.sin(turn)) for turn in turns])

    terms = {
        "joint_pos_relative": lambda: data.qpos[robot["qpos"]] - robot["home"],
        "joint_vel": lambda: data.qvel[robot["qvel"]],
        "grasp_point_to_object": grasp,
        "object_to_object": lambda a, b: data.body(b).xpos - data.body(a).xpos,
        "headings": headings,
        "last_action": lambda: targets[-1],
    }
    for step in range(steps):
        mujoco.mj_kinematics(model, data)
        for name, term in facts["observation"]["terms"].items():
            value = terms[term["func"].split(".")[-1]](**term["params"])
            value = np.clip(value, *(term["clip"] or (-np.inf, np.inf))) * term["scale"]
            past[name] = [*past.get(name, [value] * term["history"])[1:], value]
        if step % execute == 0:
            seen = np.concatenate([value for values in past.values() for value in values])
            (chunk,) = session.run(None, {"observation": np.float32([seen])})[0]
        targets.append(chunk[min(step % execute, len(chunk) - 1)])
        data.ctrl[robot["ctrl"]] = targets[-1]
        mujoco.mj_step(model, data, facts["timing"]["decimation"])
    return targets[1:]


if __name__ == "__main__":
    print("last joint targets:", play(sys.argv[1], 150)[-1])
