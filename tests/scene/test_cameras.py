"""Cameras from files of other programs: their poses, the pixel in which they see a point, and refused files."""

from __future__ import annotations

import json

import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import CONFIG, write_experiment

from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.scene.cameras import read_cameras, replace_sensors, sensor_ids
from reslrb_cli.scene.files import files_of
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.xml.mend import mend
from reslrb_cli.scene.xml.read import read_description

WIDTH, HEIGHT, FOCAL, CENTER = 40, 24, 50.0, (23.0, 9.0)
#: A pose, from camera axes (x right, y down, z forward) to the world.
ROTATION = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
ROTATION *= np.linalg.det(ROTATION)
EYE = np.array([0.3, -0.2, 4.0])
#: Pixels, and the viewing directions at these pixels in the camera's own axes.
PIXELS = np.array([[5.0, 4.0], [31.0, 20.0], [20.0, 12.0]])
RAYS = np.column_stack([(PIXELS - CENTER) / FOCAL, np.ones(3)])


@pytest.fixture
def folder(llvm, tmp_path):
    write_experiment(tmp_path)
    for name in ("a", "b"):
        mi.Bitmap(np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)).write(str(tmp_path / f"{name}.exr"))
    return tmp_path


def write_nerf(folder, **changes):
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = ROTATION @ np.diag([1, -1, -1]), EYE
    shared = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": CENTER[0], "cy": CENTER[1], "k1": 0.0}
    frames = [{"file_path": name, "transform_matrix": to_world.tolist()} for name in ("a.exr", "./b.exr")]
    path = folder / "transforms.json"
    path.write_text(json.dumps({**shared, "frames": frames, **changes}))
    return path


def quaternion(rotation):
    """Return the quaternion of a rotation, w first."""
    values, vectors = np.linalg.eigh(
        np.array(
            [
                [rotation[0, 0] - rotation[1, 1] - rotation[2, 2], 0, 0, 0],
                [rotation[0, 1] + rotation[1, 0], rotation[1, 1] - rotation[0, 0] - rotation[2, 2], 0, 0],
                [rotation[0, 2] + rotation[2, 0], rotation[1, 2] + rotation[2, 1],
                 rotation[2, 2] - rotation[0, 0] - rotation[1, 1], 0],
                [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1],
                 np.trace(rotation)],
            ]
        )
    )  # fmt: skip
    x, y, z, w = vectors[:, np.argmax(values)]
    return w, x, y, z


def write_colmap(folder, model=f"PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {CENTER[0]} {CENTER[1]}"):
    w, x, y, z = quaternion(ROTATION.T)
    t = -ROTATION.T @ EYE
    pose = " ".join(repr(float(n)) for n in (w, x, y, z, *t))
    (folder / "cameras.txt").write_text(f"# a comment\n7 {model}\n")
    (folder / "images.txt").write_text(f"# a comment\n1 {pose} 7 a.exr\n0.5 0.5 -1\n2 {pose} 7 b.exr\n\n")
    return folder / "images.txt"


def directions(scene, number):
    """Return the sensor's viewing directions at PIXELS."""
    position = mi.Point2f(*(PIXELS / (WIDTH, HEIGHT)).T)
    ray, _ = scene.sensors()[number].sample_ray(0, 0.5, position, mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(ray.o)[:, 0] + 0 * EYE, EYE, atol=0.02)  # on the near plane
    return np.array(ray.d).T


@pytest.mark.parametrize("write", [write_nerf, write_colmap])
def test_a_point_projects_to_its_pixel(folder, write):
    scene = load_scene(folder / "scene.xml", cameras=write(folder))
    assert [sensor.id() for sensor in scene.sensors()] == ["a", "b"]
    film = scene.sensors()[1].film()
    assert (list(film.size()), film.rfilter().is_box_filter()) == ([WIDTH, HEIGHT], True)
    towards = RAYS @ ROTATION.T
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(directions(scene, 1), towards, atol=1e-5)


def make(folder, cameras, run="", say=None):
    text = CONFIG.replace("target: {render: {spp: 16}}\n", "")
    text = text.replace("{file: scene.xml}", f"{{file: scene.xml, cameras: {cameras}}}")
    text = text.replace("run: {", "run: {" + run)
    return assemble(loads(text, str(folder / "tiny.yaml")), *([] if say is None else [say]))


def test_all_files_of_colmap_belong_to_the_experiment(folder):
    text = CONFIG.replace("target: {render: {spp: 16}}\n", "")
    text = text.replace("{file: scene.xml}", f"{{file: scene.xml, cameras: {write_colmap(folder).name}}}")
    found = files_of(loads(text, str(folder / "tiny.yaml")))
    names = {key: path.name for key, path in found.items() if key.startswith("scene.cameras")}
    assert names == {"scene.cameras": "images.txt", "scene.cameras (cameras.txt)": "cameras.txt",
                     "scene.cameras (a.exr)": "a.exr", "scene.cameras (b.exr)": "b.exr"}  # fmt: skip


def test_images_of_the_cameras_are_the_targets(folder):
    assert write_nerf(folder).name == "transforms.json"
    problem = make(folder, "transforms.json")
    assert [view.file.name for view in problem.views] == ["a.exr", "b.exr"]
    assert all(np.array(view.target).max() == 0.5 for view in problem.views)
    problem = make(folder, "transforms.json", "held_out: [b], ")
    assert [view.sensor for view in problem.trained] == [0]
    (folder / "b.exr").unlink()
    with pytest.raises(ConfigError, match=r"tiny.yaml: scene.cameras: .*b\.exr: no such file"):
        make(folder, "transforms.json")


def test_images_of_the_cameras_are_not_rotated(folder):
    """COLMAP finds cameras for the pixels as stored in the file, so the EXIF orientation is not applied."""
    from PIL import Image  # comes with matplotlib

    image = Image.fromarray(np.random.default_rng(3).integers(9, 200, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(folder / "a.png", exif=exif)
    path, said = write_nerf(folder), []
    path.write_text(path.read_text().replace("a.exr", "a.png"))
    problem = make(folder, path.name, say=said.append)
    assert problem.views[0].target.shape[:2] == (HEIGHT, WIDTH)
    assert any(line.startswith(f"{folder}/a.png: not turned by 90 degrees clockwise") for line in said), said


def test_a_missing_size_is_taken_from_the_images(folder):
    mi.Bitmap(np.zeros((HEIGHT // 2, WIDTH, 3), np.uint8)).write(str(folder / "b.png"))
    [camera, other] = read_cameras(write_nerf(folder, cx=None, cy=None))
    assert camera.center == other.center == (WIDTH / 2, HEIGHT / 2)
    path = write_nerf(folder, w=None, h=None, fl_x=None, fl_y=None, camera_angle_x=1.2)
    path.write_text(path.read_text().replace("./b.exr", "./b"))  # Blender's files omit the suffix
    [camera, other] = read_cameras(path)
    assert camera.size == (WIDTH, HEIGHT)
    assert (other.image.name, other.size) == ("b.png", (WIDTH, HEIGHT // 2))
    assert camera.focal == pytest.approx(WIDTH / 2 / np.tan(0.6))


BAD = [
    ({"k1": 0.01}, r"transforms.json: frames\[0\]: has distortion \(k1 = 0.01\)"),
    ({"distortion_params": [0, 0.1, 0, 0, 0, 0]}, r"frames\[0\]: has distortion \(distortion_params = "),
    *(
        ({key: model}, rf"frames\[0\].{key}: is {model}; only pinhole cameras")
        for key in ("camera_model", "camera_type", "projection")
        for model in ("OPENCV_FISHEYE", "EQUIRECTANGULAR", "ORTHOPHOTO", "OMNIDIRECTIONALSTEREO_L", "spherical", "RPC")
    ),
    *(
        ({key: True}, rf"frames\[0\].{key}: is True; only pinhole cameras")
        for key in ("is_fisheye", "Is_Fisheye", "latlong", "equirectangular", "is_orthographic", "spherical")
    ),
    ({"fl_y": 60.0}, r"frames\[0\]: has focal lengths 50 and 60"),
    ({"fl_x": None}, r"frames\[0\].fl_x: missing"),
    ({"fl_x": -3}, r"frames\[0\].fl_x: must be a positive number"),
    ({"frames": []}, "has no cameras"),
    ({"frames": 3}, "is not a transforms.json"),
    *(
        ({"frames": [{"file_path": "a.exr", **matrix}]}, r"transform_matrix: must be four rows")
        for matrix in (
            {},
            {"transform_matrix": [1]},
            {"transform_matrix": [["x"] * 4] * 4},
            {"transform_matrix": [[float("inf")] * 4] * 4},
        )
    ),
    ({"frames": [{"file_path": ""}]}, r"frames\[0\].file_path: must name the camera's image"),
    ({"frames": [{"transform_matrix": [1]}]}, r"frames\[0\].file_path: must name the camera's image"),
]


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "SIMPLE_PINHOLE", "perspective", "", None])
def test_pinholes_of_every_name_are_read(folder, model):
    changes = {"camera_model": model, "is_fisheye": False, "distortion_params": [0.0, 0, 0, 0], "k2": 0, "p1": 0.0}
    assert len(read_cameras(write_nerf(folder, **changes))) == 2


def test_images_of_one_name_have_sensors_of_their_own(folder):
    path = write_nerf(folder)
    frame = json.loads(path.read_text())["frames"][0]
    frames = [{**frame, "file_path": f"{name}.exr"} for name in ("a_", "a", "left/a", "b", "left/b")]
    description = read_description(folder / "scene.xml", {})
    replace_sensors(description, read_cameras(write_nerf(folder, frames=frames)))
    assert sensor_ids(description) == ["a_", "a", "a__", "b", "b_"]


def test_ids_of_cameras_may_be_numbers_or_have_dashes(folder):
    path = write_nerf(folder)
    mi.Bitmap(np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)).write(str(folder / "DSC-001.exr"))
    mi.Bitmap(np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)).write(str(folder / "0001.exr"))
    path.write_text(path.read_text().replace("a.exr", "0001.exr").replace("./b.exr", "DSC-001.exr"))
    for given, trained in (("DSC-001", [0]), ("DSC_001", [0]), ('"0001"', [1])):
        assert [view.sensor for view in make(folder, path.name, f"held_out: [{given}], ").trained] == trained
    with pytest.raises(ConfigError, match=r'held_out\[0\]: is the number 1, which could be an index or .* "0001"'):
        make(folder, path.name, "held_out: [0001], ")
    with pytest.raises(ConfigError, match=r"held_out\[0\]: is DSC-002, .* did you mean `DSC_001`"):
        make(folder, path.name, "held_out: [DSC-002], ")


def test_a_film_of_the_scene_keeps_its_type_and_channels(folder):
    text = (folder / "scene.xml").read_text()
    band = '<spectrum name="{}" value="400:0, 500:1, 600:0"/>'
    bands = "".join(map(band.format, ("bandA", "NIR2", "band_b")))
    (folder / "scene.xml").write_text(text.replace('<film type="hdrfilm">', f'<film type="specfilm">{bands}'))
    description = read_description(folder / "scene.xml", {})
    replace_sensors(description, read_cameras(write_nerf(folder)))
    mend(description)
    films = list(description.root.walk("film"))
    assert [film.type for film in films] == ["specfilm"] * 2
    assert [child.name for child in films[0].children if child.tag == "spectrum"] == ["bandA", "NIR2", "band_b"]


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_errors_in_a_transforms_json(folder, changes, message):
    with pytest.raises(ConfigError, match=message):
        read_cameras(write_nerf(folder, **changes))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("SIMPLE_RADIAL 40 24 50 20 12 0.02", r"cameras.txt:2: has model SIMPLE_RADIAL"),
        ("OPENCV_FISHEYE 40 24 50 50 20 12 0 0 0 0", r"cameras.txt:2: has model OPENCV_FISHEYE"),
        ("PINHOLE 40 24 50", "cameras.txt:2: is not a camera"),
        ("PINHOLE 40 24 50 51 20 12", "cameras.txt:2: has focal lengths 50 and 51"),
        ("PINHOLE 40 24 0 0 20 12", "cameras.txt:2: must have a positive focal length and size"),
        ("PINHOLE 0 24 50 50 20 12", "cameras.txt:2: must have a positive focal length and size"),
        ("", "cameras.txt:2: has model none"),
    ],
)
def test_errors_in_a_cameras_txt(folder, model, message):
    with pytest.raises(ConfigError, match=message):
        read_cameras(write_colmap(folder, model))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (" 7 b.exr", " 8 b.exr", "images.txt:4: has camera 8, which cameras.txt lacks"),
        (" 7 b.exr", " 7", "images.txt:4: has camera 7, which cameras.txt lacks, or no name"),
        (" 7 b.exr", " b.exr", "images.txt:4: is not an image: IMAGE_ID, QW, QX"),
        (" 7 b.exr", "e999 7 b.exr", "images.txt:4: has a number that is not finite"),
        (" 7 a.exr\n0.5 0.5 -1\n", " 7 a.exr\n\n\n", None),  # an empty line between images
    ],
)
def test_errors_in_an_images_txt(folder, old, new, message):
    file = write_colmap(folder)
    file.write_text(file.read_text().replace(old, new))
    (folder / "cameras.txt").write_text("\n" + (folder / "cameras.txt").read_text())
    if message is None:
        assert [camera.name for camera in read_cameras(file)] == ["a", "b"]
    else:
        with pytest.raises(ConfigError, match=message):
            read_cameras(file)
