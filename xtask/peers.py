"""The table of `cargo xtask peers`: OpenCV's semi-global matching on a recording's first pair beside our
matches of all its pairs. Arguments: FOLDER:LABEL:DISTANCE_M[:NAME=OUTPUT_FOLDER]... for each recording."""

import json
import os
import sys
import time

import cv2
import numpy as np


def camchain(folder):
    """Kalibr's camchain.yaml: per camera K, distortion, size; right_from_left."""
    cameras, transform, camera = [], [], None
    for line in open(os.path.join(folder, "camchain.yaml")):
        line = line.strip()
        if line.startswith("cam") and line.endswith(":") and line[3:-1].isdigit():
            camera = {}
            cameras.append(camera)
        elif line.startswith("- [") and len(cameras) == 2:
            transform.append(json.loads(line[2:]))
        elif ":" in line and "[" in line:
            key, value = line.split(":", 1)
            try:
                camera[key] = json.loads(value)
            except ValueError:
                pass
    for camera in cameras:
        fu, fv, pu, pv = camera["intrinsics"]
        camera["K"] = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1.0]])
        camera["D"] = np.array(camera["distortion_coeffs"])
    return cameras, np.array(transform)


def plane_rms_mm(points):
    """RMS about the plane through the central half (by area) of the view, and the part over 5 mm off."""
    u, v = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    (a, b), (c, d) = (np.percentile(t, [14.6, 85.4]) for t in (u, v))
    central = points[(u > a) & (u < b) & (v > c) & (v < d)]
    kept = central
    for _ in range(4):
        mean = kept.mean(0)
        normal = np.linalg.eigh(np.cov((kept - mean).T))[1][:, 0]
        off = np.abs((central - mean) @ normal)
        kept = central[off < 5e-3]
    residual = (kept - kept.mean(0)) @ normal
    return residual.std() * 1e3, np.mean(off >= 5e-3)


def semi_global(folder, mode, repeats):
    """Points of the first pair, and the least wall and CPU time of a match in milliseconds."""
    cameras, right_from_left = camchain(folder)
    left, right = (cv2.imread(os.path.join(folder, s, "00.png"), cv2.IMREAD_GRAYSCALE)
                   for s in ("left", "right"))
    size = left.shape[::-1]
    (k0, d0), (k1, d1) = ((c["K"], c["D"]) for c in cameras)
    r0, r1, p0, p1 = cv2.stereoRectify(
        k0, d0, k1, d1, size, right_from_left[:3, :3].copy(), right_from_left[:3, 3:].copy(), flags=0)[:4]
    rectified = []
    for image, k, d, r, p in ((left, k0, d0, r0, p0), (right, k1, d1, r1, p1)):
        maps = cv2.initUndistortRectifyMap(k, d, r, p, size, cv2.CV_32FC1)
        rectified.append(cv2.remap(image, *maps, cv2.INTER_LINEAR))
    at_infinity, focal_baseline = p0[0, 2] - p1[0, 2], -p1[0, 3]
    lowest = int(np.floor(at_infinity + focal_baseline / 2.0))
    highest = int(np.ceil(at_infinity + focal_baseline / 0.8))
    count = -(-(highest - lowest + 1) // 16) * 16
    block = 5
    matcher = cv2.StereoSGBM_create(
        minDisparity=lowest, numDisparities=count, blockSize=block, P1=8 * block**2,
        P2=32 * block**2, disp12MaxDiff=1, uniquenessRatio=10, speckleWindowSize=100,
        speckleRange=2, mode=mode)
    wall, cpu = [], []
    for _ in range(repeats):
        begun, used = time.perf_counter(), time.process_time()
        found = matcher.compute(*rectified)
        wall.append(time.perf_counter() - begun)
        cpu.append(time.process_time() - used)
    disparity = found.astype(np.float64) / 16
    y, x = np.nonzero(disparity > lowest - 1)
    z = focal_baseline / (disparity[y, x] - at_infinity)
    points = np.stack([(x - p0[0, 2]) / p0[0, 0] * z, (y - p0[1, 2]) / p0[1, 1] * z, z], 1)
    return points[(z > 0.5) & (z < 3)], min(wall) * 1e3, min(cpu) * 1e3, focal_baseline


def ours(folder):
    """Points of a reconstruction, and wall and CPU time of its match."""
    with open(os.path.join(folder, "cloud.ply"), "rb") as cloud:
        fields, count, line = [], 0, b""
        names = {b"float": "<f4", b"uchar": "u1"}
        while line.strip() != b"end_header":
            line = cloud.readline()
            words = line.split()
            if words[:2] == [b"element", b"vertex"]:
                count = int(words[2])
            if words[:1] == [b"property"]:
                fields.append((words[2].decode(), names[words[1]]))
        data = np.frombuffer(cloud.read(), np.dtype(fields), count)
    points = np.stack([data["x"], data["y"], data["z"]], 1).astype(np.float64)
    report = json.load(open(os.path.join(folder, "report.json")))
    match = next(step for step in find_steps(report) if step["stage"] == "match")
    return points, match["wall_ms"], match["cpu_ms"]


def find_steps(report):
    """The list of steps, wherever the report keeps it."""
    for value in report.values():
        if isinstance(value, list) and any(
                isinstance(step, dict) and step.get("stage") == "match" for step in value):
            return value
        if isinstance(value, dict) and (inner := find_steps(value)):
            return inner
    return None


def row(scene, method, frames, points, wall_ms, cpu_ms, px_per_mm):
    rms_mm, outliers = plane_rms_mm(points)
    print(f"| {scene} | {method} | {frames} | {wall_ms:.0f} | {cpu_ms:.0f} | {rms_mm:.4f} "
          f"| {rms_mm * px_per_mm:.4f} | {100 * outliers:.3f} | {len(points)} |", flush=True)


def main():
    print(f"OpenCV {cv2.__version__}, {cv2.getNumThreads()} threads\n")
    print("| scene | method | pairs | wall ms | CPU ms | plane RMS mm | px | over 5 mm % | points |")
    print("|---|---|---|---|---|---|---|---|---|")
    for argument in sys.argv[1:]:
        folder, scene, distance_m, *outputs = argument.split(":")
        px_per_mm = None
        for name, mode, repeats in (("StereoSGBM 3WAY", cv2.STEREO_SGBM_MODE_SGBM_3WAY, 3),
                                    ("StereoSGBM", cv2.STEREO_SGBM_MODE_SGBM, 1)):
            points, wall, cpu, focal_baseline = semi_global(folder, mode, repeats)
            px_per_mm = focal_baseline / float(distance_m) ** 2 * 1e-3
            row(scene, name, 1, points, wall, cpu, px_per_mm)
        for output in outputs:
            name, path = output.split("=", 1)
            frames = name.rsplit(" ", 1)[1]
            row(scene, name.rsplit(" ", 1)[0], frames, *ours(path), px_per_mm)


if __name__ == "__main__":
    main()
