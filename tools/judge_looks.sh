#!/usr/bin/env bash
# How a policy that sees images does in looks that it has not seen: none, those of looks=randomized, the same ranges
# wider by half (brightness: nearly twice as wide), and each look alone in its wider range. Arguments after the first
# two go to every run. One that fails names its log.
#
#     tools/judge_looks.sh outputs/lanes/pixels_looks/best outputs/looks 'scene.cameras.front.size=[96,96]' 'scene.cameras.wrist.size=[96,96]'
set -u
policy=${1:?a folder of a policy} out=${2:?a folder}
shift 2
mkdir -p "$out"
reset=gate.success.reset
terms="light object_colors table_color background camera_poses camera_fovy"
declare -A wide=(
  [brightness]="light.params.brightness=[0.4,1.5]" [light]="light.params.pos=0.6 light.params.tint=0.15"
  [object_colors]="object_colors.params.spread=0.12" [table_color]="table_color.params.spread=0.3"
  [background]="background.params.spread=0.3" [camera_fovy]="camera_fovy.params.scale=[0.925,1.075]"
  [camera_poses]="camera_poses.params.pos=0.015 camera_poses.params.angle=0.045"
)
declare -A rest=( # of a term of which one part alone is judged
  [brightness]="light.params.pos=0 light.params.tint=0" [light]="light.params.brightness=[1,1]"
)
judge() { # name, overrides
  ${PYTHON:-python} -m mjstack controller=policy policy="$policy" 'gates=[success]' nworld=2048 seed=3000000 \
    gate.success.rate=0.0001 web.episode=false "hydra.run.dir=$out/$1" "${@:2}" > "$out/$1.log" 2>&1
  echo "$1: $(grep -om1 '[0-9]* of [0-9]* episodes succeeded' "$out/$1.log" || echo "no result, see $out/$1.log")"
}
judge none "$@"
judge inside looks=randomized "$@"
everywhere=()
for look in "${!wide[@]}"; do
  ranges=() others=()
  for range in ${wide[$look]}; do everywhere+=("$reset.$range"); done
  for range in ${wide[$look]} ${rest[$look]:-}; do ranges+=("$reset.$range"); done
  for term in $terms; do [[ ${wide[$look]} == "$term".* ]] || others+=("~$reset.$term"); done
  judge "$look" looks=randomized "${ranges[@]}" "${others[@]}" "$@"
done
judge wide looks=randomized "${everywhere[@]}" "$@"
