#!/bin/bash
# Trains on this machine and on others that ssh reaches without a password:
#   HOSTS="node2 node3" CPUS=16 examples/clusters/ssh.sh env=ant plan.gmis_per_gpu=16 run.dir=/shared/ant
# The same environment must be at the same path on all. Ctrl-C and SIGTERM save and end the job.

set -u
read -ra hosts <<<"$HOSTS"
address=${ADDRESS:-$(hostname):6379}
bin=$(dirname "$(command -v ray)")
# Only processes with the token may use this Ray.
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S=0

ray start --block --head --port="${address##*:}" --num-cpus="$CPUS" \
    --include-dashboard=false --disable-usage-stats >/dev/null &
ray=$!
trap 'kill "$ray" 2>/dev/null; wait "$ray"' EXIT
until ray health-check --address "$address" 2>/dev/null; do
    kill -0 "$ray" 2>/dev/null || { echo "Ray did not start" >&2; exit 1; }
    sleep 1
done

# The other machines read the token, and end their Ray when this script ends.
for host in "${hosts[@]}"; do
    exec {input}> >(exec ssh "$host" "
        read -r RAY_AUTH_TOKEN
        export RAY_AUTH_MODE=token RAY_AUTH_TOKEN RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S=0
        '$bin/ray' start --block --address='$address' --num-cpus='$CPUS' </dev/null >/dev/null &
        cat; kill \$!; wait")
    echo "$RAY_AUTH_TOKEN" >&"$input"
done

RAY_ADDRESS=$address python -m gmijax.train "$@" \
    run.resume=auto cluster.engine=ray cluster.nodes=$((${#hosts[@]} + 1)) &
job=$!
trap 'kill -TERM "$job"' INT TERM HUP
# A signal ends `wait`, not the job: it saves first.
while :; do
    wait "$job"
    code=$?
    kill -0 "$job" 2>/dev/null || break
done
exit "$code"
