"""Recordings of sensors: packets and messages become scans, missing packages are named."""

import inspect
import struct
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import nuscenes_scene
import pytest
from cloud_files import message
from scipy.spatial import cKDTree
from shared_data import SHARED, needs_shared

from lidarflow.datasets import foreign, guess_loader, open_dataset, point_cloud2
from lidarflow.errors import InstallError

REVOLUTIONS, AZIMUTH_STEPS = 3.4, 1800     # two firings each; VLP-16 at 10 Hz
RANGE_M = 12.5
VLP16_ELEVATIONS_DEG = np.arange(-15, 16, 2)
TIMES_NS = [1_700_000_000_000_000_000 + k * 100_000_000 for k in range(3)]
CLOUDS = [np.random.default_rng(k).normal(size=(50, 3)).astype(np.float32) for k in range(3)]
POINT_FIELD = "".join(f"uint8 {kind}={code}\n" for code, kind in enumerate(
    ("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64"), 1))
SEPARATOR = "=" * 80 + "\nMSG: "
POINT_CLOUD2 = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
    "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    f"{SEPARATOR}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{SEPARATOR}sensor_msgs/PointField\n{POINT_FIELD}"
    "string name\nuint32 offset\nuint8 datatype\nuint32 count\n")


# Velodyne packets.

def velodyne_packets(range_m=RANGE_M):
    """Payloads and times [s] of a VLP-16 that sees the same range everywhere, from azimuth 0 on."""
    columns = np.arange(int(REVOLUTIONS * AZIMUTH_STEPS) // 12 * 12) % AZIMUTH_STEPS
    for first in range(0, len(columns), 12):
        blocks = b"".join(
            struct.pack("<HH", 0xEEFF, column * 36000 // AZIMUTH_STEPS)
            + struct.pack("<HB", round(range_m / 0.002), 100) * 32
            for column in columns[first:first + 12].tolist())
        time_s = first / AZIMUTH_STEPS * 0.1
        yield blocks + struct.pack("<IBB", round(time_s * 1e6), 0x37, 0x22), time_s


def write_pcap(file, payloads, order="<"):
    """Packets as UDP in IP in Ethernet."""
    with file.open("wb") as out:
        out.write(struct.pack(order + "IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for payload, time_s in payloads:
            udp = struct.pack(">HHHH", 443, 2368, 8 + len(payload), 0) + payload
            ip = struct.pack(">BBHHHBBH8s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, bytes(8))
            packet = bytes(12) + b"\x08\x00" + ip + udp
            micros = round(time_s * 1e6)
            out.write(struct.pack(order + "IIII", 1_700_000_000 + micros // 10**6, micros % 10**6,
                                  len(packet), len(packet)) + packet)
    return file


def test_velodyne_packets_are_whole_revolutions(tmp_path):
    pytest.importorskip("velodyne_decoder")
    data = open_dataset(write_pcap(tmp_path / "drive.pcap", velodyne_packets()))
    assert (data.loader, len(data)) == ("velodyne", 3), "0.4 revolutions at the end are none"
    assert data.truth(0) is None and data.world_from_sensor() is None
    times_ns = [data.scan(index).time_ns for index in (0, 2, 1)]
    assert times_ns[0] < times_ns[2] < times_ns[1]
    assert times_ns[1] - times_ns[0] == pytest.approx(0.2e9, rel=0.02)
    points = data.scan(1).points
    assert len(points) == pytest.approx(AZIMUTH_STEPS * 32, rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), RANGE_M, atol=0.1)
    elevation_deg = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    ring = np.round((elevation_deg + 15) / 2).astype(int)
    np.testing.assert_allclose(elevation_deg, VLP16_ELEVATIONS_DEG[ring], atol=0.2)
    assert (np.diff(ring) != 0).sum() == 15, "ring by ring"
    azimuth_deg = np.degrees(np.arctan2(points[ring == 0, 1], points[ring == 0, 0])) % 360
    assert np.histogram(azimuth_deg, 36, (0, 360))[0].min() > 80
    np.testing.assert_array_equal(data.scan(1).points, points)


def test_packets_say_whose_they_are(tmp_path):
    few = [(bytes(1206), 0.0)]
    for order in "<>":
        assert guess_loader(write_pcap(tmp_path / "a.pcap", few, order)) == "velodyne"
    assert guess_loader(write_pcap(tmp_path / "a.pcap", [(bytes(512), 0.0), *few])) == "velodyne"
    assert guess_loader(write_pcap(tmp_path / "a.pcap", [(bytes(6464), 0.0)])) == "ouster"
    for content in (b"", b"\x0a\x0d\x0d\x0a" + bytes(40), (tmp_path / "a.pcap").read_bytes()[:30]):
        (tmp_path / "b.pcap").write_bytes(content)
        assert guess_loader(tmp_path / "b.pcap") == "ouster"
    (tmp_path / "c.osf").touch()
    assert guess_loader(tmp_path / "c.osf") == "ouster"


def test_velodyne_recordings_that_hold_nothing(tmp_path):
    pytest.importorskip("velodyne_decoder")
    other = write_pcap(tmp_path / "a.pcap", [(bytes(6464), 0.0)])
    assert "no packet of a Velodyne sensor" in message(open_dataset, other, "velodyne")
    assert "is a folder; expected one file, .pcap" in message(open_dataset, tmp_path, "velodyne")
    whole = write_pcap(tmp_path / "b.pcap", velodyne_packets())
    assert "has no sequences" in message(open_dataset, whole, sequence="1")
    (tmp_path / "c.pcap").write_bytes(b"no packets")
    assert "the decoder of Velodyne packets failed" in message(open_dataset, tmp_path / "c.pcap", "velodyne")
    empty = open_dataset(write_pcap(tmp_path / "d.pcap", velodyne_packets(0.0)))
    assert "scan 0 is empty" in message(empty.scan, 0)
    assert "no scan 9" in message(empty.scan, 9)
    assert "scan 0 is empty" in message(next, iter(empty)) and "no scan -9" in message(empty.__getitem__, -9)


@needs_shared
@pytest.mark.parametrize("recording, converted, scans", [
    ("sample_velodyne_hdl32.pcap", "hdl32", 2), ("sample_velodyne_vlp16_gps.pcap", "vlp16", 3)])
def test_real_velodyne_packets(recording, converted, scans):
    pytest.importorskip("velodyne_decoder")
    data = open_dataset(SHARED / "mrpt_hdl32_vlp16" / recording)
    assert (data.loader, len(data)) == ("velodyne", scans)
    assert 0.09e9 < data.scan(1).time_ns - data.scan(0).time_ns < 0.12e9
    ours = np.concatenate([data.scan(index).points for index in range(scans)])
    file = SHARED / "mrpt_hdl32_vlp16" / f"{converted}_1.bin"
    theirs = np.fromfile(file, np.float32).reshape(-1, 4)[:, :3].astype(float)
    apart_m, _ = cKDTree(ours).query(theirs)
    assert np.quantile(apart_m, 0.9) < 0.03, "both by nominal angles"


# Ouster.

@needs_shared
def test_a_real_ouster_recording():
    pytest.importorskip("ouster.sdk")
    file = SHARED / "ouster_os1_128" / "OS-1-128_v2.3.0_1024x10_lb_n3.osf"
    data = open_dataset(file)
    assert (data.loader, len(data)) == ("ouster", 3)
    for index in (2, 0):
        converted = np.fromfile(SHARED / "ouster_os1_128" / f"{index:06d}.bin", np.float32).reshape(-1, 4)
        np.testing.assert_allclose(data.scan(index).points, converted[:, :3], atol=1e-4)
    assert 0.09e9 < data.scan(1).time_ns - data.scan(0).time_ns < 0.11e9
    assert "no sensor '1', 1 in all" in message(open_dataset, file, sequence="1")


def test_what_is_no_ouster_recording(tmp_path):
    pytest.importorskip("ouster.sdk")
    for name in ("a.osf", "a.pcap"):
        (tmp_path / name).write_bytes(b"not a recording")
        assert f"{name}: the Ouster SDK failed" in message(open_dataset, tmp_path / name)


# ROS.

def ros_message(make, cloud, time_ns):
    """A PointCloud2 of x, y, z float32; `make` makes a message of a type's name and its fields."""
    fields = [make("sensor_msgs/msg/PointField", name=axis, offset=4 * k, datatype=7, count=1)
              for k, axis in enumerate("xyz")]
    stamp = make("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    header = make("std_msgs/msg/Header", stamp=stamp, frame_id="lidar")
    return make("sensor_msgs/msg/PointCloud2", header=header, height=1, width=len(cloud), fields=fields,
                is_bigendian=False, point_step=12, row_step=12 * len(cloud),
                data=np.frombuffer(cloud.tobytes(), np.uint8), is_dense=True)


def write_bag(place, ros):
    """A bag of ROS 1 (a file) or ROS 2 (a folder) with the clouds on /points."""
    typesys = pytest.importorskip("rosbags.typesys")
    name = {1: "ROS1_NOETIC", 2: "ROS2_HUMBLE"}[ros]
    store = typesys.get_typestore(getattr(typesys.Stores, name))
    writer = pytest.importorskip(f"rosbags.rosbag{ros}").Writer
    # Newer releases want to be told the version of a ROS 2 bag.
    version = {"version": 8} if "version" in inspect.signature(writer).parameters else {}

    def make(kind, **fields):
        extra = {"seq": 0} if ros == 1 and kind.endswith("Header") else {}
        return store.types[kind](**extra, **fields)

    with writer(place, **version) as bag:
        kind = "sensor_msgs/msg/PointCloud2"
        topic = bag.add_connection("/points", kind, typestore=store)
        serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
        for cloud, time_ns in zip(CLOUDS, TIMES_NS, strict=True):
            bag.write(topic, time_ns, bytes(serialize(ros_message(make, cloud, time_ns), kind)))
    return place


def write_mcap(file):
    writer_module = pytest.importorskip("mcap_ros2.writer")

    def make(kind, **fields):
        return {**fields, "data": fields["data"].tobytes()} if "data" in fields else fields

    with file.open("wb") as out:
        writer = writer_module.Writer(out)
        schema = writer.register_msgdef("sensor_msgs/msg/PointCloud2", POINT_CLOUD2)
        for cloud, time_ns in zip(CLOUDS, TIMES_NS, strict=True):
            writer.write_message("/points", schema, ros_message(make, cloud, time_ns), time_ns, time_ns)
        writer.finish()
    return file


@pytest.mark.parametrize("write, loader, inside", [
    (lambda folder: write_bag(folder / "drive.bag", 1), "rosbag", ""),
    (lambda folder: write_bag(folder / "drive", 2), "rosbag", ""),
    (lambda folder: write_bag(folder / "drive", 2), "rosbag", "drive.db3"),
    (lambda folder: write_mcap(folder / "drive.mcap"), "mcap", "")])
def test_ros_recordings(tmp_path, capsys, write, loader, inside):
    data = open_dataset(write(tmp_path) / inside)
    assert (data.loader, len(data)) == (loader, 3) and "10 Hz" not in data.note
    for index in (1, 0, 2):
        scan = data.scan(index)
        np.testing.assert_array_equal(scan.points, CLOUDS[index].astype(float))
        assert abs(scan.time_ns - TIMES_NS[index]) < 1000
    assert "--sequence /points" in message(open_dataset, data.source.folder, loader, "/camera")
    assert capsys.readouterr() == ("", "")


def test_a_bag_is_closed_in_silence_when_the_program_ends(tmp_path):
    bag = write_bag(tmp_path / "drive", 2)
    code = (f"from lidarflow.datasets import open_dataset\ndata = open_dataset({str(bag)!r})\n"
            "print(data.scan(1).name)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("000001\n", "")


def test_point_clouds_of_any_layout():
    row = np.dtype({"names": ["y", "x", "z"], "formats": [">f8", ">f8", ">i2"], "offsets": [0, 8, 16],
                    "itemsize": 20})
    rows = np.zeros((2, 3), row)
    rows["x"], rows["y"], rows["z"] = [[1, 2, 3], [4, np.nan, 6]], 0.5, -7
    data = b"".join(line.tobytes() + b"pad" for line in rows)
    fields = [SimpleNamespace(name=name, offset=row.fields[name][1], datatype=code)
              for name, code in (("y", 8), ("x", 8), ("z", 3))]
    cloud = SimpleNamespace(
        fields=fields, is_bigendian=True, point_step=20, row_step=63, height=2, width=3, data=data)
    points, times = point_cloud2.read(cloud)
    np.testing.assert_array_equal(points, [[x, 0.5, -7] for x in (1, 2, 3, 4, 6)])
    assert len(times) == 0
    cloud.data = data[:-1]
    assert "125 bytes for 2 rows of 3 points; the recording is damaged" in message(point_cloud2.read, cloud)
    cloud.fields = fields[:2]
    assert "has the fields y, x; expected x, y and z" in message(point_cloud2.read, cloud)


# nuScenes.

def test_a_scene_of_nuscenes(tmp_path):
    pytest.importorskip("nuscenes")
    folder = nuscenes_scene.write_scene(tmp_path / "nuscenes")
    assert "needs a sequence; choose one with --sequence" in message(open_dataset, folder)
    data = open_dataset(folder, sequence="61")
    assert (data.loader, len(data)) == ("nuscenes", 3) and "10 Hz" not in data.note
    for index in (2, 0):
        np.testing.assert_array_equal(data.scan(index).points, nuscenes_scene.CLOUDS[index].astype(float))
        assert data.scan(index).time_ns == nuscenes_scene.TIMES_US[index] * 1000
    steps_m = np.diff(data.world_from_sensor()[:, 0, 3])
    np.testing.assert_allclose(steps_m, nuscenes_scene.STEP_M, atol=1e-3)
    assert "not available" in message(open_dataset, folder, sequence="9999")


def test_nuscenes_is_known_by_its_tables(tmp_path):
    assert guess_loader(nuscenes_scene.write_scene(tmp_path)) == "nuscenes"


# Packages.

@pytest.mark.parametrize("loader, module, command", [
    ("velodyne", "velodyne_decoder", "pip install velodyne-decoder"),
    ("ouster", "ouster.sdk", "pip install 'ouster-sdk>=1.0'"),
    ("rosbag", "rosbags.highlevel", "pip install"),
    ("mcap", "mcap_ros2.reader", "pip install mcap-ros2-support"),
    ("nuscenes", "nuscenes", "pip install nuscenes-devkit")])
def test_a_missing_package_is_named_with_the_command(tmp_path, monkeypatch, loader, module, command):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / "drive").touch()
    with pytest.raises(InstallError) as caught:
        open_dataset(tmp_path / "drive", loader, "0" if loader == "nuscenes" else None)
    assert command in str(caught.value) and "\n" not in str(caught.value)


def test_what_a_failed_object_prints_at_its_end_is_caught(capsys, monkeypatch):
    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)     # pytest has its own

    class Half:
        def __init__(self):
            raise OSError("no such bag") from ValueError("deep inside")

        def __del__(self):
            raise AssertionError("was never open")

    assert message(foreign.guarded, "origin", Half) == "origin failed (OSError: no such bag)"
    assert capsys.readouterr() == ("", "")


def test_a_stream_starts_again_for_what_lies_behind():
    starts = []

    def start():
        starts.append(0)
        return iter("abc")

    stream = foreign.Stream(start)
    assert [stream.item(index) for index in (1, 1, 2, 0, 1)] == list("bbcab") and len(starts) == 2
    with pytest.raises(IndexError):
        stream.item(3)
    assert stream.item(0) == "a"
