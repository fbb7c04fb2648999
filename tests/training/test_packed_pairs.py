"""Packed pairs are those of the folders, bit for bit, from a disk and from an object store."""

import json
import tarfile

import pytest
import torch
from tiny_pairs import relit_folder, rendered_folder

from splatgraft_paper.training.sources.packed_pairs import PackedPairs, pack_pairs
from splatgraft_paper.training.sources.relit_pairs import RelitPairs
from splatgraft_paper.training.sources.rendered_pairs import RenderedPairs


@pytest.fixture
def sources(tmp_path):
    return [RenderedPairs(rendered_folder(tmp_path / "rendered", 2)), RelitPairs(relit_folder(tmp_path / "relit", 3))]


def assert_same(packed, sources):
    folders = [(source, i) for source in sources for i in range(len(source))]
    assert len(packed) == len(folders) == 2 + 6
    for number, (source, i) in enumerate(folders):
        one, other = packed.read(number), source.read(i)
        for role in ("composite", "target", "background", "mask"):
            assert torch.equal(getattr(one, role), getattr(other, role))
        assert packed.location(number) == source.location(i)
        assert packed.group(number).endswith(source.group(i))
    keys = {packed.key(i, role) for i in range(len(packed)) for role in ("composite", "target")}
    # two lights share a target
    assert len(keys) == 8 + 5


def test_packed_pairs_are_those_of_the_folders(tmp_path, sources):
    assert pack_pairs(sources, tmp_path / "packed", shard_bytes=20_000) == 8
    shards = sorted((tmp_path / "packed").glob("*.tar"))
    assert len(shards) > 1
    names = []
    for shard in shards:
        with tarfile.open(shard) as content:
            names += content.getnames()
    # per rendered scene 4 files; per relit sample 3 and two lights
    assert len(set(names)) == len(names) == 2 * 4 + 3 * 5
    assert_same(PackedPairs(str(tmp_path / "packed")), sources)
    with pytest.raises(ValueError, match=r"index.jsonl: expected no packed pairs, found some; name another folder"):
        pack_pairs(sources, tmp_path / "packed", shard_bytes=20_000)


def test_they_are_read_from_an_object_store(tmp_path, sources):
    import fsspec

    pack_pairs(sources, tmp_path / "packed", shard_bytes=20_000)
    store = fsspec.filesystem("memory")
    store.put(str(tmp_path / "packed") + "/", "memory://bucket/packed/", recursive=True)
    assert_same(PackedPairs("memory://bucket/packed"), sources)
    store.rm("memory://bucket/packed/pairs-00000.tar")
    with pytest.raises(ValueError, match=r"pairs-00000.tar: expected a shard of packed pairs, found"):
        PackedPairs("memory://bucket/packed").read(0)


def test_damaged_packs_are_one_line(tmp_path, sources):
    with pytest.raises(ValueError, match=r"nowhere/index.jsonl: expected the index of packed pairs, found"):
        PackedPairs(str(tmp_path / "nowhere"))
    packed = tmp_path / "packed"
    pack_pairs(sources, packed, shard_bytes=10**9)
    shard = packed / "pairs-00000.tar"
    shard.write_bytes(shard.read_bytes()[:512])
    with pytest.raises(ValueError, match=r"pairs-00000.tar: expected the pictures of .*, found target.png: expected"):
        PackedPairs(str(packed)).read(0)
    (packed / "index.jsonl").write_text(json.dumps({"target": 1}) + "\n")
    with pytest.raises(ValueError, match=r"index.jsonl, line 1: expected a packed pair, found"):
        PackedPairs(str(packed))
