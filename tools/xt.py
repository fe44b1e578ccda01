import sys, torch, mjstack, math
from pathlib import Path
from mjstack.episodes.stage import Stage
from mjstack.math import norm, quat_z_row
task, robot, worlds, n, every = sys.argv[1], sys.argv[2], eval(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5])
ex = Path("examples")/task/"conf"
cfg = mjstack.load_config([f"task={task}", f"robot={robot}", "controller=closed_loop","controller.clock=false","reset=randomized","sim=native", *sys.argv[6:]], config_dir=ex if ex.exists() else None)
st = Stage(cfg)
env = st.start(st.batch_simulation(len(worlds)), cfg.reset, worlds=worlds)
d = st.driver(env)
cap = {}
lp = d._lead_point
def wrapped(state, points, due):
    r = lp(state, points, due); cap.update(state=state, points=points, due=due, turn=r[2], target=r[0], phase=r[1]); return r
d._lead_point = wrapped
names=[p.name for p in d._plan]
for step in range(n):
    env.step(d.command().clone())
    if step % every == 0:
        for w in range(len(worlds)):
            s, due, k = cap["state"], cap["due"], int(cap["phase"][w])
            at = s.pos[w, due.object[w]] + due.offset[w] if due.led[w] else s.point[w]
            off = (at - cap["points"][w, k])*1e3
            mv=(cap["target"][w]-s.point[w])*1e3
            from mjstack.mdp.geometry import pose_w
            q = pose_w(env, list(cfg.scene.objects)[int(due.object[w])])[w,3:]
            tilt = math.degrees(math.acos(min(1,abs(float(quat_z_row(q[None])[0,2])))))
            print(step, w, names[k].ljust(10), "off %6.1f %6.1f %6.1f"%tuple(off.tolist()), "mv %5.1f %5.1f %5.1f"%tuple(mv.tolist()), "turn %.3f"%float(cap["turn"][w]), "open %.2f"%float(s.opening[w]), "g%d l%d c%d o%d v%d"%tuple(int(x[w]) for x in (due.grasped,due.led,due.closes,due.opens,due.over)), "lean %.1f"%math.degrees(math.acos(min(1,-float(s.approach[w,2])))), "tilt %.1f"%tilt, "F", [round(float(x),1) for x in __import__("mjstack.mdp.geometry",fromlist=["x"]).jaw_forces(env.index, env.sim, list(cfg.scene.objects)[int(due.object[w])])[w]], "gv %.2f"%float(env.sim.qvel[w, env.index.robot_qvel[-1] if hasattr(env.index,"robot_qvel") else 5]), "placed", st.check.placed(env.state)[w].tolist())
