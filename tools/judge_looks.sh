#!/usr/bin/env bash
# How a policy that sees images does in looks that it has not seen: none, those of looks=randomized, the same ranges
# wider by half (brightness: nearly twice as wide), and each look alone in its wider range. Arguments after the first
# two go to every run.
#
#     tools/judge_looks.sh outputs/lanes/pixels_looks/best outputs/looks 'scene.cameras.front.size=[96,96]' 'scene.cameras.wrist.size=[96,96]'
set -u
policy=${1:?a folder of a policy} out=${2:?a folder}
shift 2
reset=gate.success.reset
declare -A wide=(
  [light]="light.params.brightness=[0.4,1.5] light.params.pos=0.6 light.params.tint=0.15"
  [object_colors]="object_colors.params.spread=0.12" [table_color]="table_color.params.spread=0.3"
  [background]="background.params.spread=0.3" [camera_fovy]="camera_fovy.params.scale=[0.925,1.075]"
  [camera_poses]="camera_poses.params.pos=0.015 camera_poses.params.angle=0.045"
)
judge() { # name, overrides
  ${PYTHON:-python} -m mjstack controller=policy policy="$policy" 'gates=[success]' nworld=2048 seed=3000000 \
    gate.success.rate=0.0001 web.episode=false "hydra.run.dir=$out/$1" "${@:2}" | grep -o '[0-9]* of [0-9]* episodes succeeded' | head -n 1 | sed "s/^/$1: /"
}
judge none "$@"
judge inside looks=randomized "$@"
everywhere=()
for look in "${!wide[@]}"; do
  ranges=() others=()
  for range in ${wide[$look]}; do ranges+=("$reset.$range"); done
  for other in "${!wide[@]}"; do [[ $other == "$look" ]] || others+=("~$reset.$other"); done
  judge "$look" looks=randomized "${ranges[@]}" "${others[@]}" "$@"
  everywhere+=("${ranges[@]}")
done
judge wide looks=randomized "${everywhere[@]}" "$@"
