import sys, torch, mjstack, math
from pathlib import Path
from mjstack.episodes.stage import Stage
from mjstack.mdp.geometry import pose_w
from mjstack.math import quat_z_row
task, robot, worlds = sys.argv[1], sys.argv[2], eval(sys.argv[3])
ex = Path("examples")/task/"conf"
cfg = mjstack.load_config([f"task={task}", f"robot={robot}", "controller=closed_loop","reset=randomized","sim=native", *sys.argv[4:]], config_dir=ex if ex.exists() else None)
st = Stage(cfg); env = st.start(st.batch_simulation(len(worlds)), cfg.reset, worlds=worlds); d = st.driver(env)
ends={p.stop-1:p.name for p in d.phases}
for step in range(d.steps):
    env.step(d.command().clone())
    if step in ends:
        a = d._ik.forward(d._measure().q)[2]
        q = pose_w(env, list(cfg.scene.objects)[0])[:,3:]
        print(ends[step].ljust(10), "lean", [round(math.degrees(math.acos(min(1,-float(z)))),1) for z in a[:,2]], "tilt", [round(math.degrees(math.acos(min(1,abs(float(z))))),1) for z in quat_z_row(q)[:,2]])
