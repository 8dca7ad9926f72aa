#!/bin/bash
#SBATCH --job-name=gmijax
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --exclusive
#SBATCH --time=08:00:00
#SBATCH --signal=B:USR1@120
#SBATCH --requeue
#SBATCH --open-mode=append
#
# Trains on all nodes of a Slurm job, and continues in the next job when its time is up:
#   sbatch slurm.sh env=ant plan.gmis_per_gpu=16 run.dir=/shared/ant
# Modules and environments of yours belong here.

set -u
cpus=$SLURM_CPUS_PER_TASK nodes=$SLURM_JOB_NUM_NODES
first=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
export RAY_ADDRESS=$first:$((20000 + SLURM_JOB_ID % 10000))
# Only processes with the token may use this Ray; Slurm passes the variables to its tasks.
RAY_AUTH_TOKEN=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S=0

# One task on each node starts Ray, and holds it until the task is ended.
srun --nodes="$nodes" --ntasks-per-node=1 --cpus-per-task="$cpus" --kill-on-bad-exit=0 \
    bash -c '
if [ "$SLURM_PROCID" = 0 ]; then
    exec ray start --block --head --port="${RAY_ADDRESS##*:}" --num-cpus="$1" \
        --include-dashboard=false --disable-usage-stats
fi
until ray health-check --address "$RAY_ADDRESS" 2>/dev/null; do sleep 1; done
exec ray start --block --address="$RAY_ADDRESS" --num-cpus="$1"
' ray "$cpus" &
ray=$!
trap 'kill "$ray" 2>/dev/null; wait "$ray"' EXIT

until ray health-check --address "$RAY_ADDRESS" 2>/dev/null; do
    kill -0 "$ray" 2>/dev/null || { echo "Ray did not start" >&2; exit 1; }
    sleep 1
done

# The batch script runs on the first node, where Ray's head is.
python -m gmijax.train "$@" run.resume=auto cluster.engine=ray cluster.nodes="$nodes" &
job=$!
requeue=
trap 'requeue=yes; kill -TERM "$job"' USR1
trap 'kill -TERM "$job"' TERM

# A signal ends `wait`, not the job: it saves first.
while :; do
    wait "$job"
    code=$?
    kill -0 "$job" 2>/dev/null || break
done
if [ "$requeue" ] && [ "$code" = 130 ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
