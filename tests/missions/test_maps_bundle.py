"""Archives and XML that nobody vouches for: read within bounds, or refused by name."""

from __future__ import annotations

import io
import stat
import struct
import zipfile
import zlib
from pathlib import Path
from xml.etree.ElementTree import canonicalize, fromstring, tostring

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from companion.errors import MapError
from missions.maps import bundle
from missions.maps.bundle import files_beside, open_bundle, parse_xml


def zipped(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def renamed(path: Path, old: bytes, new: bytes) -> Path:
    """Put other bytes of the same length for a name, as other programs would."""
    assert len(old) == len(new)
    path.write_bytes(path.read_bytes().replace(old, new))
    return path


def refusal(path: Path) -> MapError:
    """Open and read everything, which has to be refused in one line."""
    with pytest.raises(MapError) as caught:
        whole(path)
    assert "\n" not in str(caught.value)
    assert caught.value.fix
    return caught.value


def whole(path: Path) -> dict[str, bytes]:
    found = open_bundle(path)
    return {name: found.read(name) for name in found.names}


FILES = {"Rx/a.SHP": b"shape", "Rx/a.dbf": b"table" * 100, "TaskData.xml": b"<x/>"}


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_zip_and_a_folder_give_the_same_files(tmp_path: Path, method: int) -> None:
    folder = tmp_path / "folder"
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    for path in (folder, zipped(tmp_path / "a.zip", FILES, method)):
        assert whole(path) == FILES
        found = open_bundle(path)
        assert found.with_suffix(".shp", ".tif") == ["Rx/a.SHP"]
        assert found.called("TASKDATA.XML") == ["TaskData.xml"]


def test_what_a_computer_leaves_behind_is_left_aside(tmp_path: Path) -> None:
    litter = {"__MACOSX/Rx/._a.SHP": b"", "Rx/.DS_Store": b"", "._a.xml": b"", "Rx/": b""}
    assert whole(zipped(tmp_path / "a.zip", FILES | litter)) == FILES


def test_an_archive_in_an_archive_stays_shut(tmp_path: Path) -> None:
    inner = zipped(tmp_path / "inner.zip", FILES).read_bytes()
    assert whole(zipped(tmp_path / "a.zip", {"inner.zip": inner})) == {"inner.zip": inner}


def test_backslashes_part_folders_as_slashes_do(tmp_path: Path) -> None:
    path = renamed(zipped(tmp_path / "a.zip", {"Rx/a.shp": b"x"}), b"Rx/a.shp", b"Rx\\a.shp")
    assert whole(path) == {"Rx/a.shp": b"x"}


@pytest.mark.parametrize(
    "name",
    [b"/etc/passwd1", b"../../../abc", b"..\\..\\..\\abc", b"C:\\file.shp0", b"a/../../b.sh"],
)
def test_a_name_that_leads_out_is_refused(tmp_path: Path, name: bytes) -> None:
    path = renamed(zipped(tmp_path / "a.zip", {"abcdefgh.shp": b"x"}), b"abcdefgh.shp", name)
    assert refusal(path).code == "archive-unsafe"


def test_a_control_character_in_a_name_is_refused(tmp_path: Path) -> None:
    path = renamed(zipped(tmp_path / "a.zip", {"abcd.shp": b"x"}), b"abcd.shp", b"\x1b[2J.shp")
    assert refusal(path).code == "archive-unsafe"


def test_a_name_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.zip", {"a.shp": b"1", "b.shp": b"2"})
    assert refusal(renamed(path, b"b.shp", b"a.shp")).code == "archive-unsafe"


def test_a_link_in_an_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        entry = zipfile.ZipInfo("a.shp")
        entry.create_system = 3
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")
    assert refusal(path).code == "archive-unsafe"


def test_a_link_in_a_folder_is_not_followed(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    (secret / "in").mkdir(parents=True)
    (secret / "in" / "a.shp").write_bytes(b"x")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "a.shp").symlink_to(secret / "in" / "a.shp")
    (folder / "loop").symlink_to(folder)
    (folder / "in").symlink_to(secret / "in")
    (folder / "own.shp").write_bytes(b"y")
    assert whole(folder) == {"own.shp": b"y"}


def test_a_zip_bomb_is_refused_unread(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.zip", {"a.shp": bytes(64 * 1024**2)})
    assert path.stat().st_size < 100_000
    assert refusal(path).code == "archive-unsafe"


def test_a_grid_of_zeros_is_no_bomb(tmp_path: Path) -> None:
    cells = bytes(4_000_000)
    assert whole(zipped(tmp_path / "a.zip", {"GRD00001.BIN": cells})) == {"GRD00001.BIN": cells}


def test_many_large_members_are_refused_by_their_sum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = zipped(tmp_path / "a.zip", {f"{index}.shp": bytes(600) for index in range(4)})
    monkeypatch.setattr(bundle, "MAX_FILE_BYTES", 2_399)
    assert refusal(path).code == "too-large"
    monkeypatch.setattr(bundle, "MAX_FILE_BYTES", 2_400)
    assert len(whole(path)) == 4


def field_of(path: Path, name: bytes, at: int, value: bytes, *, local: int | None = None) -> Path:
    """Overwrite a field of a member's central header, and the same of its local header."""
    content = bytearray(path.read_bytes())
    central = content.rindex(b"PK\1\2", 0, content.rindex(name))
    content[central + at : central + at + len(value)] = value
    if local is not None:
        start = struct.unpack_from("<L", content, central + 42)[0]
        content[start + local : start + local + len(value)] = value
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("size", [10, 2_000])
def test_a_member_that_is_longer_or_shorter_than_it_says_is_refused(
    tmp_path: Path, size: int
) -> None:
    path = zipped(tmp_path / "a.zip", {"a.shp": bytes(range(250)) * 4})
    field_of(path, b"a.shp", 24, struct.pack("<L", size), local=22)
    assert refusal(path).code in ("truncated", "archive-unsafe")


def test_a_member_gives_no_more_than_it_says_to_hold(tmp_path: Path) -> None:
    bomb = bytes(8 * 1024**2)
    path = zipped(tmp_path / "a.zip", {"a.shp": bomb})
    field_of(path, b"a.shp", 24, struct.pack("<L", 100), local=22)
    field_of(path, b"a.shp", 16, struct.pack("<L", zlib.crc32(bytes(100))), local=14)
    found = open_bundle(path)
    assert len(found.read("a.shp")) == 100


def test_members_that_share_their_bytes_are_refused(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.zip", {"a.shp": bytes(5_000), "b.shp": bytes(5_000)})
    field_of(path, b"b.shp", 42, struct.pack("<L", 0))
    error = refusal(path)
    assert error.code == "archive-unsafe"
    assert "overlaps" in str(error)


def test_an_encrypted_member_is_refused(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.zip", {"a.shp": b"x"})
    field_of(path, b"a.shp", 8, struct.pack("<H", 1), local=6)
    error = refusal(path)
    assert (error.code, "encrypted" in str(error)) == ("archive-unsafe", True)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_packing_without_a_bound_on_its_gain_is_refused(tmp_path: Path, method: int) -> None:
    assert refusal(zipped(tmp_path / "a.zip", {"a.shp": b"x"}, method)).code == "archive-unsafe"


def test_thousands_of_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = zipped(tmp_path / "a.zip", {f"{index}": b"" for index in range(2_001)})
    assert refusal(path).code == "too-large"
    many = tmp_path / "many.zip"
    many.write_bytes(b"PK\1\2" * 8_001)
    assert refusal(many).code == "too-large"
    monkeypatch.setattr(bundle, "MAX_MEMBERS", 2)
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in "ab":
        (folder / name).write_bytes(b"")
    assert len(whole(folder)) == 2
    (folder / "c").write_bytes(b"")
    assert refusal(folder).code == "too-large"


def test_folders_deep_in_each_other_are_refused(tmp_path: Path) -> None:
    deep = tmp_path / "/".join("abcdefghi")
    deep.mkdir(parents=True)
    assert refusal(tmp_path).code == "too-large"
    assert refusal(zipped(tmp_path / "a.zip", {"a/" * 9 + "a.shp": b""})).code == "archive-unsafe"
    assert whole(zipped(tmp_path / "b.zip", {"a/" * 8 + "a.shp": b""}))


def test_a_folder_that_may_not_be_looked_into_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: object) -> object:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(bundle.os, "scandir", refuse)
    assert refusal(tmp_path).code == "no-file"


@pytest.mark.parametrize(
    ("raw", "meant"),
    [
        ("地块.shp".encode("gbk"), "地块.shp"),
        ("地块.shp".encode(), "地块.shp"),
        ("Prés.shp".encode("cp437"), "Prés.shp"),
        ("señal.shp".encode("cp437"), "señal.shp"),
    ],
)
def test_names_without_the_flag_for_utf_8_are_read_as_meant(
    tmp_path: Path, raw: bytes, meant: str
) -> None:
    stand_in = b"a" * len(raw)
    path = renamed(zipped(tmp_path / "a.zip", {stand_in.decode(): b"x"}), stand_in, raw)
    assert open_bundle(path).names == (meant,)


def test_names_in_utf_8_are_read(tmp_path: Path) -> None:
    assert whole(zipped(tmp_path / "a.zip", {"논/밭.shp": b"x"})) == {"논/밭.shp": b"x"}


@pytest.mark.parametrize("keep", [0, 10, 60, 0.5, 0.9])
def test_an_archive_cut_off_is_refused(tmp_path: Path, keep: float) -> None:
    path = zipped(tmp_path / "a.zip", FILES)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content)) if 0 < keep < 1 else int(keep)])
    assert refusal(path).code == "truncated"


@given(
    changed=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=5),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
)
@hypothesis_settings(max_examples=150)
def test_any_bytes_of_an_archive_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, changed: list[tuple[float, int]], keep: float
) -> None:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in FILES.items():
            archive.writestr(name, part)
    content = bytearray(made.getvalue())
    for place, byte in changed:
        content[int(place * len(content))] = byte
    path = tmp_path_factory.getbasetemp() / "any.zip"
    path.write_bytes(content[: int(keep * len(content))] if keep < 1.0 else content)
    try:
        assert set(whole(path).values()) <= set(FILES.values())
    except MapError as error:
        assert "\n" not in str(error)


def test_a_file_is_found_with_what_belongs_to_it(tmp_path: Path) -> None:
    for name in ("Rx.tif", "rx.TFW", "Rx-Metadata.json", "other.tfw"):
        (tmp_path / name).write_bytes(name.encode())
    found = files_beside(tmp_path / "Rx.tif")
    assert found.names == ("Rx-Metadata.json", "Rx.tif", "rx.TFW")
    assert found.read("rx.TFW") == b"rx.TFW"
    with pytest.raises(MapError) as caught:
        files_beside(tmp_path / "none" / "Rx.tif")
    assert caught.value.code == "no-file"


# XML


def parsed(content: bytes | str) -> str:
    raw = content.encode() if isinstance(content, str) else content
    return canonicalize(tostring(parse_xml(raw, Path("a.xml")), encoding="unicode"))


def xml_refusal(content: bytes | str) -> MapError:
    with pytest.raises(MapError, match=r"^a\.zip: TASKDATA\.XML: ") as caught:
        raw = content.encode() if isinstance(content, str) else content
        parse_xml(raw, Path("a.zip"), name="TASKDATA.XML")
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize(
    "content",
    [
        "<a/>",
        "<a b='1' c='2'>t<b>u</b>tail<!-- c --><?pi x?>more</a>",
        "<a xmlns='urn:x' xmlns:y='urn:y' y:k='1' k='2'><y:b/><b/></a>",
        "<a>&amp;&lt;&#228;<![CDATA[<x>]]></a>",
        "<kml xmlns='http://www.opengis.net/kml/2.2' xmlns:gx='urn:gx'><gx:t>1</gx:t></kml>",
    ],
)
def test_a_tree_is_what_the_standard_library_makes_of_it(content: str) -> None:
    assert parsed(content) == canonicalize(tostring(fromstring(content), encoding="unicode"))


@pytest.mark.parametrize(
    ("encoding", "declared"),
    [
        ("utf-8", ""),
        ("utf-8-sig", ""),
        ("utf-8", "UTF-8"),
        ("utf-8-sig", "utf-8"),
        ("iso-8859-1", "ISO-8859-1"),
        ("cp1252", "windows-1252"),
        ("utf-16", "UTF-16"),
    ],
)
def test_text_is_read_in_the_encoding_that_is_declared(encoding: str, declared: str) -> None:
    head = f"<?xml version='1.0' encoding='{declared}'?>" if declared else ""
    tree = parse_xml(f"{head}<a b='Höfe'>Gülle</a>".encode(encoding), Path("a.xml"))
    assert (tree.get("b"), tree.text) == ("Höfe", "Gülle")


@pytest.mark.parametrize(
    ("encoding", "text"), [("GBK", "地块"), ("euc-kr", "논"), ("Shift_JIS", "畑"), ("Big5", "田")]
)
def test_encodings_of_several_bytes_a_letter_are_read(encoding: str, text: str) -> None:
    content = f'<?xml version="1.0" encoding="{encoding}"?><a>{text}</a>'.encode(encoding)
    assert parse_xml(content, Path("a.xml")).text == text


@pytest.mark.parametrize(
    "content",
    [
        "<?xml version='1.0' encoding='UTF-8'?><a>Gülle und mehr</a>".encode("latin-1"),
        "<a>Gülle und mehr</a>".encode("latin-1"),
        b"<?xml version='1.0' encoding='GBK'?><a>\xff\xff</a>",
    ],
)
def test_text_in_another_encoding_than_declared_is_refused(content: bytes) -> None:
    assert xml_refusal(content).code == "encoding"


LAUGHS = "<!DOCTYPE a [<!ENTITY x 'ha'><!ENTITY y '&x;&x;&x;'>]><a>&y;</a>"


@pytest.mark.parametrize(
    "content",
    [
        LAUGHS,
        LAUGHS.encode("utf-16"),
        "<!DOCTYPE a SYSTEM 'file:///etc/passwd'><a/>",
        "<!DOCTYPE a [<!ENTITY x SYSTEM 'file:///etc/passwd'>]><a>&x;</a>",
        "<!DOCTYPE a [<!ENTITY % x SYSTEM 'http://localhost/'> %x;]><a/>",
        "<!DOCTYPE a><a/>",
        "<a>" * 65 + "</a>" * 65,
        "<a " + " ".join(f"b{index}='1'" for index in range(257)) + "/>",
        f"<{'a' * 1001}/>",
        f"<a {'b' * 1001}='1'/>",
        f"<a xmlns:x='{'u' * 1001}'><x:b/></a>",
        f"<a xmlns:x='{'u' * 1001}' x:b='1'/>",
    ],
)
def test_what_no_map_needs_is_refused(content: bytes | str) -> None:
    assert xml_refusal(content).code == "xml-unsafe"


def test_depth_and_attributes_up_to_the_limit_are_read() -> None:
    assert parsed("<a>" * 64 + "</a>" * 64)
    assert parsed("<a " + " ".join(f"b{index}='1'" for index in range(256)) + "/>")
    assert parsed(f"<a b='{'c' * 1_000_000}'/>")


def test_more_elements_than_any_map_has_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "MAX_ELEMENTS", 3)
    assert parsed("<a><b/><b/></a>")
    assert xml_refusal("<a><b/><b/><b/></a>").code == "too-large"


@pytest.mark.parametrize(
    "content",
    [
        "",
        " ",
        "<a>",
        "<a></b>",
        "<a/><b/>",
        "text",
        "<a>\0</a>",
        b"\0" * 100,
        "<a>&nbsp;</a>",
        "<a b='1' b='2'/>",
        "<x:a/>",
        "<?xml version='1.0' encoding='no-such'?><a/>",
        "<?xml version='1.0' encoding='utf-7'?><a/>",
        "<a>ü".encode()[:-1],
        b"PK\3\4",
    ],
)
def test_what_is_no_whole_xml_is_refused(content: bytes | str) -> None:
    assert xml_refusal(content).code == "truncated"


@given(
    changed=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=5),
    keep=st.just(1.0) | st.floats(0.0, 1.0),
)
@hypothesis_settings(max_examples=300)
def test_any_bytes_of_xml_are_read_or_refused(
    changed: list[tuple[float, int]], keep: float
) -> None:
    head = '<?xml version="1.0" encoding="UTF-8"?>'
    content = bytearray(f'{head}<a xmlns:x="urn:x" b="ü"><x:c x:d="1"/>t</a>'.encode())
    for place, byte in changed:
        content[int(place * len(content))] = byte
    try:
        parse_xml(bytes(content[: int(keep * len(content)) + 1]), Path("a.xml"))
    except MapError as error:
        assert "\n" not in str(error)
