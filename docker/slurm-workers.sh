#!/usr/bin/env bash
# Workers as a Slurm array: pilots that pull shards, never one scheduler job per shard.
#
#   export HYDROFLEX_DATABASE=postgres://…  AWS_ACCESS_KEY_ID=…  AWS_SECRET_ACCESS_KEY=…
#   sbatch docker/slurm-workers.sh s3://bucket/prefix
#
# The coordinator runs elsewhere, on a host that stays up. Cancel or lose any task at any time: its shard goes
# to another worker. Tried with Slurm 22.05 on one node (submitted, worked, drained by scancel); untried on a cluster.
#SBATCH --job-name=hydroflex
#SBATCH --array=1-32
#SBATCH --cpus-per-task=4
#SBATCH --mem-per-cpu=1G
#SBATCH --time=04:00:00
#SBATCH --requeue
set -euo pipefail
store=${1:?usage: sbatch slurm-workers.sh STORE_URL}

# Stop taking shards five minutes before the wall time, and finish the one in hand.
exec hydroflex worker --store "$store" --threads "$SLURM_CPUS_PER_TASK" --drain-after 14100
