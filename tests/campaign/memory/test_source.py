import hashlib
from dataclasses import replace

import campaigns
import frames

from counterspin.campaign.description import read_campaign
from counterspin.campaign.memory.making import make_campaign


def sha(data):
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def test_a_file_is_known_by_its_bytes(tmp_path):
    file = campaigns.write(tmp_path, "# a comment\n" + campaigns.SMALL)
    source = read_campaign(tmp_path).source
    assert source.content_checksum() == sha(file.read_bytes())
    assert (source.in_memory, source.label) == (False, str(file))


def test_a_change_is_known_by_what_would_be_written(tmp_path):
    file = campaigns.write(tmp_path, campaigns.SMALL)
    campaign = read_campaign(tmp_path)
    changed = campaign.change(radius="2.6 m")
    assert changed.source.changed == ("centrifuge.radius",)
    assert changed.source.content_checksum() != sha(file.read_bytes())
    assert str(changed.path) == changed.source.label == f"{file}, changed in memory"
    for name in ("slow", "middle", "fast"):
        (tmp_path / f"{name}.csv").write_text("time_s\n0\n", encoding="utf-8")
    written = changed.write(tmp_path / "written")
    assert changed.source.content_checksum() == sha(written.read_bytes())


def test_what_is_changed_back_is_the_file_again(tmp_path):
    file = campaigns.write(tmp_path, campaigns.SMALL)
    back = read_campaign(tmp_path).change(radius="2.6 m").change(radius="2.5 m")
    assert not back.source.in_memory
    assert back.source.content_checksum() == sha(file.read_bytes())


def test_a_copy_with_a_part_replaced_has_no_source():
    campaign = make_campaign(frames.small())
    assert campaign.source is not None
    assert replace(campaign, title="other").source is None
