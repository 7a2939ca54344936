"""Make the buckets that are named on the command line: python buckets.py mlflow dvc."""

from __future__ import annotations

import sys

import boto3
from botocore.config import Config

# The store may still start: the client asks again, for up to some minutes.
s3 = boto3.client("s3", config=Config(retries={"mode": "standard", "total_max_attempts": 20}))
there = {bucket["Name"] for bucket in s3.list_buckets()["Buckets"]}
for name in sys.argv[1:]:
    if name not in there:
        s3.create_bucket(Bucket=name)
    print(f"bucket {name} is there")
