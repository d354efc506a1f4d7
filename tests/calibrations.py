"""Small calibration files of every tool that is read or refused by name: what is in them, and what has to come out."""

import json

import numpy as np

SIZE = (640, 480)
K = [700.0, 0.0, 310.5, 0.0, 705.0, 245.0, 0.0, 0.0, 1.0]
ROWS = [K[:3], K[3:6], K[6:]]
D = [0.31, 0.12, 0.001, -0.002, 0.05]
FISHEYE = [0.03, 0.01, 0.001, 0.0005]
RATIONAL = [0.3, 0.1, 0.001, 0.0, 0.02, 0.01, 0.002, 0.003]


def camera(d=D, model="plumb_bob", k=K, size=SIZE):
    return (size, k, model, d)


PLUMB, EQUI, RATIO = camera(), camera(FISHEYE, "equidistant"), camera(RATIONAL, "rational_polynomial")
FOUR, NONE = camera([0.31, 0.12, 0.001, -0.002]), camera([0.0] * 5)


def matrix(key, numbers, rows=1):
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {len(numbers) // rows}\n   dt: d\n   data: {numbers}\n"


def opencv(
    k="camera_matrix", d="distortion_coefficients", numbers=D, more="", size="image_width: 640\nimage_height: 480\n"
):
    return f"%YAML:1.0\n---\n{size}{more}{matrix(k, K, 3)}{matrix(d, numbers)}"


def xml(k="camera_matrix", d="distortion_coefficients", numbers=D):
    def body(key, values, rows):
        return (
            f'<{key} type_id="opencv-matrix"><rows>{rows}</rows><cols>{len(values) // rows}</cols><dt>d</dt>'
            f"<data>{' '.join(map(str, values))}</data></{key}>"
        )

    size = "<image_width>640</image_width><image_height>480</image_height>"
    return f'<?xml version="1.0"?><opencv_storage>{size}{body(k, K, 3)}{body(d, numbers, 1)}</opencv_storage>'


def ros(model="distortion_model: plumb_bob", numbers=D, head="", more=""):
    return (
        f"{head}image_width: 640\nimage_height: 480\ncamera_name: c\ncamera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        f"{model}\ndistortion_coefficients: {{rows: 1, cols: {len(numbers)}, data: {numbers}}}\n{more}"
    )


def kalibr(model="pinhole", lens="radtan", d=D[:4], intrinsics=(700.0, 705.0, 310.5, 245.0), head="", name="cam0"):
    return (
        f"{head}{name}:\n  camera_model: {model}\n  intrinsics: {list(intrinsics)}\n  distortion_model: {lens}\n"
        f"  distortion_coeffs: {d}\n  resolution: [640, 480]\n"
    )


def calibio(form="CameraModelOpenCV", tau=0.0):
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
    numbers = dict(zip(names, [*D, *[0.0] * 7, tau, 0.0], strict=True))
    numbers |= {"f": 700.0, "ar": 705.0 / 700.0, "cx": 310.5, "cy": 245.0}
    parameters = {name: {"val": value, "state": 0} for name, value in numbers.items()}
    base = {"CameraModelBase": {"imageSize": {"width": 640, "height": 480}}}
    model = {
        "polymorphic_name": f"libCalib::{form}",
        "ptr_wrapper": {"data": {"CameraModelCRT": base, "parameters": parameters}},
    }
    return json.dumps({"Calibration": {"cameras": [{"model": model}]}})


def orbslam(form="PinHole", prefix="Camera1", terms=None):
    terms = terms or {"k1": 0.31, "k2": 0.12, "p1": 0.001, "p2": -0.002, "k3": 0.05}
    numbers = {"fx": 700.0, "fy": 705.0, "cx": 310.5, "cy": 245.0} | terms
    lines = [f"{prefix}.{name}: {value}" for name, value in numbers.items()]
    return "\n".join(
        ["%YAML:1.0", "---", f'Camera.type: "{form}"', *lines, "Camera.width: 640", "Camera.height: 480", ""]
    )


def metashape(more="", projection="frame"):
    terms = "<k1>0.31</k1><k2>0.12</k2><k3>0.05</k3><p1>-0.002</p1><p2>0.001</p2>"
    # fx is f + b1; the centre counts from the middle of the picture, whose corner is (0, 0)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n'
        f"<projection>{projection}</projection><width>640</width><height>480</height><f>705.0</f><b1>-5.0</b1>"
        f"<cx>-9.0</cx><cy>5.5</cy>{terms}{more}</calibration>"
    )


OST = f"""# oST version 5.0 parameters

[image]

width
640

height
480

[narrow_stereo]

camera matrix
{" ".join(map(str, K[:3]))}
{" ".join(map(str, K[3:6]))}
0 0 1

distortion
{" ".join(map(str, D))}
"""
BOUGUET = f"""% Intrinsic and Extrinsic Camera Parameters
fc = [ 700.0 ; 705.0 ];
cc = [ 310.5 ; 245.0 ];
alpha_c = 0.0;
kc = [ {" ; ".join(map(str, D))} ];
fc_error = [ 1.1 ; 1.2 ];
nx = 640;
ny = 480;
"""
CAMODOCAL = """%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters: {k1: 0.31, k2: 0.12, p1: 0.001, p2: -0.002}
projection_parameters: {fx: 700.0, fy: 705.0, cx: 310.5, cy: 245.0}
"""
ECHO = f"""header:
  frame_id: cam
height: 480
width: 640
distortion_model: plumb_bob
d: {D}
k: {K}
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
p: [700, 0, 310.5, 0, 0, 705, 245, 0, 0, 0, 1, 0]
binning_x: 0
binning_y: 0
roi: {{x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}}
---
"""
PHOTONVISION = json.dumps(
    {
        "resolution": {"width": 640.0, "height": 480.0},
        "cameraIntrinsics": {"rows": 3, "cols": 3, "type": 6, "data": K},
        "distCoeffs": {"rows": 1, "cols": 8, "type": 6, "data": RATIONAL},
        "calobjectWarp": [0.1, 0.2],
    }
)
EUROC = (
    "sensor_type: camera\ncamera_model: pinhole\nresolution: [640, 480]\nintrinsics: [700.0, 705.0, 310.5, 245.0]\n"
    f"distortion_model: radial-tangential\ndistortion_coefficients: {D[:4]}\n"
)
STEREO = "image_width: 640\nimage_height: 480\n" + "".join(
    matrix(f"{letter}{side}", numbers, rows) for side in (1, 2) for letter, numbers, rows in (("M", K, 3), ("D", D, 1))
)
BINNED = camera(size=(320, 240), k=[350.0, 0, 155.0, 0, 352.5, 122.25, 0, 0, 1])

WINDOW = camera(size=(200, 150), k=[350.0, 0, 105.0, 0, 352.5, 92.25, 0, 0, 1])
COLUMN = f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n{matrix('K', K, 3)}{matrix('D', D[:4], 4)}"
GYROFLOW = json.dumps(
    {"calib_dimension": {"w": 640, "h": 480}, "fisheye_params": {"camera_matrix": ROWS, "distortion_coeffs": FISHEYE}}
)

# tool, what of it, content, and the camera that comes out or the words of the refusal
FILES = [
    ("OpenCV YAML", "camera_matrix, distortion_coefficients", opencv(), PLUMB),
    *(
        ("OpenCV YAML", f"{k}, {d}", opencv(k, d), PLUMB)
        for k, d in (
            ("cameraMatrix", "distCoeffs"),
            ("Camera_Matrix", "Distortion_Coefficients"),
            ("K", "D"),
            ("mtx", "dist"),
            ("intrinsic_matrix", "dist_coeff"),
            ("camera_matrix", "distortion"),
            ("M1", "D1"),
        )
    ),
    ("OpenCV YAML", "image_Width, image_Height", opencv(size="image_Width: 640\nimage_Height: 480\n"), PLUMB),
    ("OpenCV YAML", "4 coefficients", opencv(numbers=D[:4]), FOUR),
    ("OpenCV YAML", "8 coefficients", opencv(numbers=RATIONAL), RATIO),
    ("OpenCV YAML", "12 or 14 coefficients, the last ones zero", opencv(numbers=[*RATIONAL, *[0.0] * 6]), RATIO),
    ("OpenCV YAML", "thin prism", opencv(numbers=[*RATIONAL, 0.01, 0.0, 0.0, 0.0]), "thin prism"),
    ("OpenCV YAML", "tilted sensor", opencv(numbers=[*RATIONAL, *[0.0] * 4, 0.01, 0.0]), "tilted sensor"),
    ("OpenCV YAML", "fisheye_model: 1", opencv(numbers=FISHEYE, more="fisheye_model: 1\n"), EQUI),
    (
        "OpenCV YAML",
        "four coefficients that may be a fisheye's",
        opencv(numbers=[0.1, 0.2, 0.3, -0.1]),
        "of a fisheye?",
    ),
    ("OpenCV YAML", "four coefficients, one below the other", COLUMN, "of a fisheye?"),
    ("OpenCV YAML", "stereo (M1, D1, M2, D2)", "%YAML:1.0\n---\n" + STEREO, "choose with --name: 1, 2"),
    (
        "OpenCV YAML",
        "unknown key that could be distortion",
        opencv(d="radial_terms"),
        "radial_terms: could be distortion",
    ),
    ("OpenCV YAML", "no distortion", opencv(d="other"), "no distortion beside it"),
    ("OpenCV YAML", "no image size", opencv(size=""), "give --size"),
    ("OpenCV YAML", "omnidirectional (xi)", opencv(more="xi: 1.2\n"), "omnidirectional camera"),
    ("OpenCV YAML", "decimal commas", opencv().replace("700.0", "700,0"), "decimal commas"),
    ("OpenCV XML", "camera_matrix, distortion_coefficients", xml(), PLUMB),
    ("OpenCV XML", "Camera_Matrix, Distortion_Coefficients", xml("Camera_Matrix", "Distortion_Coefficients"), PLUMB),
    ("JSON of a script", "K, dist, image_size", json.dumps({"K": ROWS, "dist": [D], "image_size": [640, 480]}), PLUMB),
    (
        "JSON of a script",
        "camera_matrix, dist_coeff, img_shape (rows first)",
        json.dumps({"camera_matrix": ROWS, "dist_coeff": [D], "img_shape": [480, 640]}),
        PLUMB,
    ),
    (
        "JSON of a script",
        "left and right",
        json.dumps({side: {"K": ROWS, "D": D} for side in ("left", "right")} | {"image_size": [640, 480]}),
        "choose with --name: left, right",
    ),
    ("ROS camera_info YAML", "plumb_bob", ros(), PLUMB),
    ("ROS camera_info YAML", "rational_polynomial", ros("distortion_model: rational_polynomial", RATIONAL), RATIO),
    ("ROS camera_info YAML", "rational_polynomial of 5", ros("distortion_model: rational_polynomial", D), PLUMB),
    (
        "ROS camera_info YAML",
        "14 coefficients, zeros at the end",
        ros("distortion_model: rational_polynomial", [*RATIONAL, *[0.0] * 6]),
        RATIO,
    ),
    ("ROS camera_info YAML", "equidistant", ros("distortion_model: equidistant", FISHEYE), EQUI),
    ("ROS camera_info YAML", "fisheye", ros("distortion_model: fisheye", FISHEYE), EQUI),
    ("ROS camera_info YAML", "camera_model: in place of distortion_model:", ros("camera_model: plumb_bob"), PLUMB),
    ("ROS camera_info YAML", "no model: as ROS, plumb_bob", ros("camera_name2: x"), PLUMB),
    ("ROS camera_info YAML", "no coefficients", ros(numbers=[]), NONE),
    ("ROS camera_info YAML", "byte order mark", "\ufeff" + ros(), PLUMB),
    ("ROS camera_info YAML", "binning_x, binning_y", ros(more="binning_x: 2\nbinning_y: 2\n"), BINNED),
    (
        "ROS camera_info YAML",
        "region of interest, then binning",
        ros(more="binning_x: 2\nbinning_y: 2\nroi: {x_offset: 100, y_offset: 60, width: 400, height: 300}\n"),
        WINDOW,
    ),
    (
        "ROS camera_info YAML",
        "region of interest off the sensor",
        ros(more="roi: {x_offset: 500, y_offset: 60, width: 400, height: 300}\n"),
        "is not on a sensor of 640x480",
    ),
    ("ROS camera_info YAML", "another model", ros("distortion_model: warp"), "distortion model 'warp'"),
    ("ROS camera_info YAML", "skew", ros().replace("[700.0, 0.0", "[700.0, 0.35"), "a skew of 0.35 px"),
    ("ROS CameraInfo message", "as `ros2 topic echo` prints it", ECHO, PLUMB),
    ("ROS INI (ost.txt)", "five or eight coefficients", OST, PLUMB),
    ("Kalibr", "pinhole, radtan", kalibr(), FOUR),
    ("Kalibr", "pinhole, equi or equidistant", kalibr(lens="equi", d=FISHEYE), EQUI),
    ("Kalibr", "with a `%YAML:1.0` head (OpenVINS)", kalibr(head="%YAML:1.0 # comment\n\n"), FOUR),
    ("Kalibr", "several cameras", kalibr() + kalibr(name="cam1"), "choose with --name: cam0, cam1"),
    ("Kalibr", "omni", kalibr("omni", intrinsics=(1.7, 700, 705, 310, 245)), "camera model 'omni'"),
    ("Kalibr", "ds", kalibr("ds", "none", [], (-0.2, 0.6, 700, 705, 310, 245)), "camera model 'ds'"),
    ("Kalibr", "eucm", kalibr("eucm", "none", [], (0.5, 1.0, 700, 705, 310, 245)), "camera model 'eucm'"),
    ("Kalibr", "fov", kalibr(lens="fov", d=[0.92]), "distortion model 'fov'"),
    ("EuRoC", "sensor.yaml", EUROC, FOUR),
    ("ORB-SLAM", "PinHole", orbslam(), PLUMB),
    (
        "ORB-SLAM",
        "KannalaBrandt8",
        orbslam("KannalaBrandt8", "Camera", dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))),
        EQUI,
    ),
    ("camodocal (VINS)", "PINHOLE", CAMODOCAL, FOUR),
    ("camodocal (VINS)", "MEI", CAMODOCAL.replace("PINHOLE", "MEI"), "camodocal's model 'MEI'"),
    (
        "COLMAP cameras.txt",
        "OPENCV",
        "# Camera list\n1 OPENCV 640 480 700 705 311 245.5 0.31 0.12 0.001 -0.002\n",
        FOUR,
    ),
    (
        "COLMAP cameras.txt",
        "FULL_OPENCV",
        f"1 FULL_OPENCV 640 480 700 705 311 245.5 {' '.join(map(str, RATIONAL))}\n",
        RATIO,
    ),
    (
        "COLMAP cameras.txt",
        "OPENCV_FISHEYE",
        f"1 OPENCV_FISHEYE 640 480 700 705 311 245.5 {' '.join(map(str, FISHEYE))}\n",
        EQUI,
    ),
    ("COLMAP cameras.txt", "PINHOLE", "1 PINHOLE 640 480 700 705 311 245.5\n", NONE),
    ("COLMAP cameras.txt", "FOV", "1 FOV 640 480 700 705 311 245.5 0.9\n", "COLMAP's model FOV"),
    (
        "COLMAP cameras.txt",
        "several cameras",
        "1 PINHOLE 9 9 9 9 4 4\n2 PINHOLE 9 9 9 9 4 4\n",
        "choose with --name: 1, 2",
    ),
    ("Metashape XML", "frame", metashape(), PLUMB),
    ("Metashape XML", "k4, b2", metashape("<b2>0.3</b2>"), "skew (b2)"),
    ("Metashape XML", "fisheye", metashape(projection="fisheye"), "another model than OpenCV's"),
    ("calib.io JSON", "OpenCV model", calibio(), PLUMB),
    ("calib.io JSON", "tilted sensor", calibio(tau=0.01), "tilted sensor"),
    ("calib.io JSON", "other models", calibio("CameraModelDoubleSphere"), "calib.io's CameraModelDoubleSphere"),
    ("PhotonVision JSON", "as exported", PHOTONVISION, RATIO),
    ("Matlab, Bouguet's toolbox", "Calib_Results.m", BOUGUET, PLUMB),
    ("MATLAB", "cameraParameters as JSON", '{"FocalLength": [7, 7], "RadialDistortion": [0, 0]}', "of MATLAB"),
    ("MATLAB", ".mat", "MATLAB 5.0 MAT-file, Platform", "a MAT-file of MATLAB"),
    ("Gyroflow", "lens profile", GYROFLOW, EQUI),
    ("DepthAI", "as stored on the camera", '{"cameraData": []}', "a calibration of DepthAI"),
    ("RealSense", "intrinsics as JSON", '{"width": 640, "height": 480, "ppx": 320, "ppy": 240}', "of RealSense"),
    ("ZED", "SN*.conf", "[LEFT_CAM_HD]\nfx=700\n", "a calibration of ZED"),
    ("SVO or OKVIS", "cameras", "cameras:\n- camera: {label: cam0}\n", "of SVO or OKVIS"),
    ("KITTI", "calib.txt", "P0: 718 0 607 0 0 718 185 0 0 0 1 0\n", "a calibration of KITTI"),
    ("DSO", "camera.txt", "Pinhole 0.5 0.6 0.5 0.5 0\n640 480\ncrop\n640 480\n", "of a direct VO"),
    ("OCamCalib", "calib_results.txt", "#polynomial coefficients for the DIRECT mapping\n5 -69\n", "of OCamCalib"),
    (
        "RealityCapture",
        "XMP",
        '<x xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:FocalLength35mm="24"/>',
        "of RealityCapture",
    ),
    ("Basalt", "calibration.json", '{"value0": {"intrinsics": []}}', "a calibration of Basalt"),
    ("nerfstudio", "transforms.json", '{"fl_x": 700, "frames": []}', "a calibration of nerfstudio"),
    ("lumidock", "a station file", "schema: 1\nname: a\nlights: []\n", "a station file"),
]


def write(path, content):
    """Write a content with the byte order mark that it may begin with."""
    path.write_bytes(content.encode())
    return path


def same(found, wanted):
    """Whether a camera is the one that is wanted: (size, K, model, distortion)."""
    size, k, model, d = wanted
    return (
        (found.width, found.height, found.model) == (*size, model)
        and np.allclose(found.K.reshape(-1), k, rtol=0, atol=1e-9)
        and len(found.distortion) == len(d)
        and np.allclose(found.distortion, d, rtol=0, atol=1e-12)
    )
