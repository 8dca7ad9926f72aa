"""Exchanges on the streams of GPUs, through their memory and NCCL."""
