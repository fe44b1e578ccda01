#!/usr/bin/env bash
# Trainings that have not been run on CUDA, side by side on one GPU, each with a log. Any of them goes on where it was
# stopped.
#
#     tools/gpu_lanes.sh outputs/lanes ppo_stack_0 ppo_stack_1 ppo_stack_2
#     LIFT=mine/conf tools/gpu_lanes.sh outputs/lanes ppo_lift    # the folder of docs/own_tasks.md
set -u
out=${1:?a folder}
shift
sizes() { echo "scene.cameras.front.size=[$1,$1] scene.cameras.wrist.size=[$1,$1]"; }
held() { # two thirds of each range of looks=randomized: the rest stays unseen
  echo "reset.light.params.pos=0.2667 reset.light.params.brightness=[0.7333,1.1333] reset.light.params.tint=0.0667"
  echo "reset.object_colors.params.spread=0.0533 reset.table_color.params.spread=0.1333"
  echo "reset.background.params.spread=0.1333 reset.camera_poses.params.pos=0.00667"
  echo "reset.camera_poses.params.angle=0.02 reset.camera_fovy.params.scale=[0.9667,1.0333]"
}
pixels="experiment=pixels nworld=2048 job.rounds=12 job.vision.pool=900000" # 10 minutes on an H100
ppo="trainer=ppo nworld=4096 job.iterations=null gate.success.rate=0.0001"
declare -A lanes=(
  [ppo_lift]="--config-dir ${LIFT:-lift/conf} task=lift $ppo job.minutes=10"
  [hz10]="nworld=2048 job.chunk=5 job.execute=5 job.beta_decay=1 gate.success.seeds=2"
  [delay]="nworld=2048 trainer=clone timing.command_delay=5 gate.success.seeds=2"
  [pixels_rebot]="$pixels $(sizes 96) robot=rebot"
  [pixels_looks]="$pixels $(sizes 96) looks=randomized job.rounds=15"
  [pixels_held]="$pixels $(sizes 96) looks=randomized $(held) job.rounds=15"
  [real_arm]="$pixels $(sizes 96) experiment=[pixels,real_arm,real_arm_student] job.rounds=9 job.episodes=6144"
  [pixels_wrist]="$pixels cameras=wrist scene.cameras.wrist.size=[96,96]"
  [pixels_front]="$pixels cameras=front scene.cameras.front.size=[96,96]"
)
for seed in 0 1 2; do
  lanes[ppo_stack_$seed]="$ppo reset=expert_states job.minutes=20 seed=$seed"
  lanes[pixels_$seed]="$pixels $(sizes 96) seed=$seed"
done
lanes[pixels_64]="$pixels $(sizes 64)"
lanes[pixels_128]="$pixels $(sizes 128) job.vision.pool=500000"
lanes[pixels_160]="$pixels $(sizes 160) job.vision.pool=320000"
for name; do
  [[ -n ${lanes[$name]:-} ]] || { echo "no lane $name: there are ${!lanes[*]}" >&2; exit 2; }
done
mkdir -p "$out"
for name; do
  # shellcheck disable=SC2086 # a lane is several words
  ${PYTHON:-python} -m mjstack job=train ${lanes[$name]} "job.folder=$out/$name" >> "$out/$name.log" 2>&1 &
done
wait
tail -n 3 "$out"/*.log
