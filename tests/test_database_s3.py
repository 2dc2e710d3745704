"""A database in an object store, tried against a local server that speaks S3."""

import pytest
import torch
from helpers import descriptors

from ssrvlad_torch import Database


@pytest.fixture
def bucket(monkeypatch):
    server_of = pytest.importorskip("moto.server", reason="needs moto")
    boto3 = pytest.importorskip("boto3")
    server = server_of.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    settings = {
        "AWS_ENDPOINT": f"http://{host}:{port}",
        "AWS_ALLOW_HTTP": "true",
        "AWS_ACCESS_KEY_ID": "nobody",
        "AWS_SECRET_ACCESS_KEY": "nothing",
        "AWS_REGION": "us-east-1",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    boto3.client("s3", endpoint_url=settings["AWS_ENDPOINT"]).create_bucket(Bucket="town")
    yield "s3://town"
    server.stop()


def test_a_database_lives_in_a_bucket(bucket):
    uri = f"{bucket}/morning.ssrdb"
    assert not Database.exists(uri)
    database, numbers = Database.create(uri, width=8), descriptors(0, 3, 8)
    database.append(["a/1", "a/2", "a/3"], numbers)
    database.replace(["a/1"], torch.zeros(1, 8))
    database.remove(["a/2"])
    with pytest.raises(ValueError, match=r"frame 'a/1' is in s3://town/morning\.ssrdb already"):
        database.append(["a/1"], numbers[:1])
    opened = Database.open(uri)
    assert Database.exists(uri)
    assert opened.verify() == []
    assert opened.load().frames == ("a/1", "a/3")
    assert torch.equal(opened.load().descriptors[1], numbers[2])
    assert [entry.frames for entry in opened.history()] == [0, 3, 3, 2]
    opened.compact(keep_days=0)
    assert len(Database.open(uri)) == 2
