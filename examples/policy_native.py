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
    modes = {term["params"].get("mode") for term in facts["action"]["terms"].values()}
    assert modes == {"absolute"}, "actions that are no joint targets"
    model = mujoco.MjModel.from_binary_path(f"{folder}/model.mjb")
    data = mujoco.MjData(model)
    robot, execute = facts["robot"], facts["action"]["execute"]
    objects = {name: o["shape"] for name, o in facts["objects"].items() if not o["fixed"]}
    data.qpos[robot["qpos"]] = data.ctrl[robot["ctrl"]] = robot["home"]
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    model.vis.quality.offsamples = 0
    cameras = facts["observation"].get("images", {}).items()
    renderers = {name: mujoco.Renderer(model, *size) for name, size in cameras}
    past, targets = {}, []

    def image(name: str) -> np.ndarray:
        renderers[name].update_scene(data, name, option)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderers[name].scene.flags[flag] = 0
        return renderers[name].render()[None]

    def positions() -> np.ndarray:
        return np.array([data.body(name).xpos for name in objects])

    def offsets() -> np.ndarray:
        return positions() - np.mean([data.site(k).xpos for k in robot["grasp_sites"]], axis=0)

    def headings() -> np.ndarray:
        turns = [data.body(name).xmat for name, shape in objects.items() if shape == "box"]
        yaws = np.array([4 * np.arctan2(turn[3], turn[0]) for turn in turns])
        return np.stack([np.cos(yaws), np.sin(yaws)], axis=1)

    def tilts() -> np.ndarray:
        turns = [data.body(name).xmat.reshape(3, 3) for name in objects]
        ups = [turn[:, np.abs(turn[2]).argmax()] for turn in turns]
        return np.array([up[:2] * np.sign(up[2]) for up in ups])

    def grasped() -> list[float]:
        jaws = [facts["objects"][name]["jaw_force"] for name in objects]
        forces = [[np.linalg.norm(data.sensordata[a : a + 3]) for a in pair] for pair in jaws]
        return [float(min(pair) > 1e-5) for pair in forces]  # N

    terms = {
        "joint_pos_relative": lambda: data.qpos[robot["qpos"]] - robot["home"],
        "joint_vel": lambda: data.qvel[robot["qvel"]],
        "offsets": offsets,
        "positions": positions,
        "headings": headings,
        "tilts": tilts,
        "grasped": grasped,
        "goals": lambda: [place["xy"] for place in facts["places"].values()],
    }
    for step in range(steps):
        mujoco.mj_fwdPosition(model, data)
        for name, term in facts["observation"]["terms"].items():
            value = np.ravel(terms[term["func"].split(".")[-1]](**term["params"]))
            value = np.clip(value, *(term["clip"] or (-np.inf, np.inf))) * term["scale"]
            past[name] = [*past.get(name, [value] * term["history"])[1:], value]
        if step % execute == 0:
            seen = np.concatenate([value for values in past.values() for value in values])
            images = {f"images.{name}": image(name) for name in renderers}
            (chunk,) = session.run(None, {"observation": np.float32([seen]), **images})[0]
        targets.append(chunk[min(step % execute, len(chunk) - 1)])
        if step >= facts["timing"]["command_delay"]:
            data.ctrl[robot["ctrl"]] = targets[-1 - facts["timing"]["command_delay"]]
        mujoco.mj_step(model, data, facts["timing"]["decimation"])
    return targets


if __name__ == "__main__":
    print("last joint targets:", play(sys.argv[1], 150)[-1])
