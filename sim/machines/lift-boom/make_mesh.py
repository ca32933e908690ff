#!/usr/bin/env python3
"""Makes lift-boom.inp: the mesh of hydroflex's built-in lift boom, a welded box-section boom of our own design.

    pip install gmsh==4.15.0 numpy
    python make_mesh.py lift-boom.inp

Hardpoints (pivot, cylinder eye, payload pin, tip sensor) are those of the boom of Khadim et al. (arXiv 2503.07528);
the shape, the plates and the mesh are ours. Boom frame: origin on the pivot axis, x along the boom, y up, z along the
pins. Lengths in metres.

Construction: two web plates cut from one tapered outline, top and bottom flanges between them, two closing plates,
and three bushes welded through the webs. Quadratic tetrahedra (C3D10): linear ones are about 10 % too stiff in
bending at this size. Midside nodes are straight-sided, so that a bore is a polygon in both orders.
"""
import sys

import gmsh
import numpy as np

# Plates.
WEB_THICKNESS = 0.007
FLANGE_THICKNESS = 0.009
CLOSING_THICKNESS = 0.010
FLANGE_HALF_WIDTH = {0.0: 0.130, 3.0: 0.082}  # by x: the flanges taper towards the tip, in plan
HALF_WIDTH = 0.074  # outside of the webs, and half the length of the payload bush

# Bushes: axis (x, y), bore radius, outer radius, half length.
PIVOT = (0.0, 0.0, 0.025, 0.045, 0.100)
EYE = (0.30419, -0.10001, 0.036, 0.060, 0.100)
PAYLOAD = (2.875, 0.01515, 0.046, 0.062, 0.074)

# Outline of a web, counter-clockwise from the lower edge behind the pivot.
LOWER_FRONT = [(0.43, -0.100), (2.80, -0.050)]  # carries the bottom flange
TOP = [(2.80, 0.080), (0.55, 0.112), (0.08, 0.095)]  # carries the top flange, from the tip to the pivot
OUTLINE = ([(-0.055, -0.055), (0.16, -0.075), (0.235, -0.165), (0.37, -0.165)] + LOWER_FRONT
           + [(2.925, -0.040), (2.945, 0.015), (2.925, 0.070)] + TOP + [(-0.055, 0.055)])
CLOSING_X = [0.47, 2.70]  # closing plates across the box

# Element sizes.
SIZE_PLATE = 0.065
SIZE_BORE = 0.024
DIGITS = 8  # of the coordinates in the file: 0.01 µm


def polygon(points, z):
    occ = gmsh.model.occ
    tags = [occ.addPoint(x, y, z) for x, y in points]
    lines = [occ.addLine(a, b) for a, b in zip(tags, tags[1:] + tags[:1])]
    return occ.addPlaneSurface([occ.addCurveLoop(lines)])


def plate(points, z0, z1):
    return [t for t in gmsh.model.occ.extrude([(2, polygon(points, z0))], 0, 0, z1 - z0) if t[0] == 3]


def strip(path, thickness):
    """The path, and the path moved to its left by the thickness: a plate seen from the side."""
    p = np.array(path)
    edge = np.diff(p, axis=0)
    normal = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]
    inner = [p[0] + thickness * normal[0]]
    for i in range(1, len(p) - 1):  # mitre at the bends
        mitre = normal[i - 1] + normal[i]
        inner.append(p[i] + thickness * mitre / (1 + normal[i - 1] @ normal[i]))
    inner.append(p[-1] + thickness * normal[-1])
    return [tuple(q) for q in p] + [tuple(q) for q in inner[::-1]]


def height_at(path, x):
    p = sorted(path)
    return float(np.interp(x, [a for a, _ in p], [b for _, b in p]))


def solid():
    occ = gmsh.model.occ
    parts = plate(OUTLINE, HALF_WIDTH - WEB_THICKNESS, HALF_WIDTH) + plate(OUTLINE, -HALF_WIDTH, WEB_THICKNESS - HALF_WIDTH)
    inside = HALF_WIDTH - WEB_THICKNESS
    for path in (LOWER_FRONT, TOP):
        wide = plate(strip(path, FLANGE_THICKNESS), -0.2, 0.2)
        plan = [(x, z) for x, z in FLANGE_HALF_WIDTH.items()] + [(x, -z) for x, z in list(FLANGE_HALF_WIDTH.items())[::-1]]
        points = [occ.addPoint(x, -0.5, z) for x, z in plan]
        lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1])]
        prism = occ.extrude([(2, occ.addPlaneSurface([occ.addCurveLoop(lines)]))], 0, 1, 0)
        parts += occ.intersect(wide, [t for t in prism if t[0] == 3])[0]
    for x in CLOSING_X:
        low, high = height_at(LOWER_FRONT, x), height_at(TOP, x)
        parts += plate([(x, low), (x + CLOSING_THICKNESS, low), (x + CLOSING_THICKNESS, high), (x, high)], -inside, inside)
    cylinder = lambda b, r: [(3, occ.addCylinder(b[0], b[1], -b[4], 0, 0, 2 * b[4], r))]
    for bush in (PIVOT, EYE, PAYLOAD):
        parts += cylinder(bush, bush[3])
    body, _ = occ.fuse(parts[:1], parts[1:])
    bores = [t for bush in (PIVOT, EYE, PAYLOAD) for t in cylinder(bush, bush[2])]
    body, _ = occ.cut(body, bores)
    occ.synchronize()
    assert len(body) == 1, f"the parts do not form one body: {body}"


def main(path):
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.NumThreads", 1)
    gmsh.option.setNumber("Mesh.RandomSeed", 1)
    solid()
    # Small near the bushes, growing to the plate size.
    field = gmsh.model.mesh.field
    faces = []
    for x, y, _, outer, half in (PIVOT, EYE, PAYLOAD):
        r = outer + 1e-3
        faces += [t for _, t in gmsh.model.getEntitiesInBoundingBox(x - r, y - r, -half - 1e-3, x + r, y + r, half + 1e-3, 2)]
    distance = field.add("Distance")
    field.setNumbers(distance, "SurfacesList", faces)
    threshold = field.add("Threshold")
    for key, value in dict(InField=distance, SizeMin=SIZE_BORE, SizeMax=SIZE_PLATE, DistMin=0.0, DistMax=0.15).items():
        field.setNumber(threshold, key, value)
    field.setAsBackgroundMesh(threshold)
    for key in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
        gmsh.option.setNumber(f"Mesh.{key}", 0)
    gmsh.option.setNumber("Mesh.Algorithm3D", 1)
    gmsh.option.setNumber("Mesh.Optimize", 1)
    gmsh.option.setNumber("Mesh.OptimizeNetgen", 1)
    gmsh.option.setNumber("Mesh.SecondOrderLinear", 1)
    gmsh.model.mesh.generate(3)
    gmsh.model.mesh.setOrder(2)
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    _, connectivity = gmsh.model.mesh.getElementsByType(11)
    elements = connectivity.reshape(-1, 10).astype(int)
    x = dict(zip(tags.astype(int), coordinates.reshape(-1, 3)))
    used = np.unique(elements)
    number = {int(t): i + 1 for i, t in enumerate(used)}
    position = np.array([x[int(t)] for t in used])
    tets = np.vectorize(number.get)(elements)
    tets[:, [8, 9]] = tets[:, [9, 8]]  # gmsh: edges 2-3, 1-3; Abaqus: 1-3, 2-3
    # Straight-sided to the last digit: corners rounded first, midsides from the rounded corners.
    position = np.round(position, DIGITS)
    for k, (a, b) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]):
        position[tets[:, 4 + k] - 1] = (position[tets[:, a] - 1] + position[tets[:, b] - 1]) / 2
    gmsh.finalize()
    with open(path, "w") as out:
        out.write("** hydroflex built-in lift boom, made by make_mesh.py with gmsh; metres\n*NODE\n")
        for i, p in enumerate(position):
            out.write(f"{i + 1}," + ",".join(f"{c + 0.0:.{DIGITS + 1}f}".rstrip("0").rstrip(".") for c in p) + "\n")
        out.write("*ELEMENT, TYPE=C3D10, ELSET=BOOM\n")
        for i, e in enumerate(tets):
            out.write(f"{i + 1}," + ",".join(map(str, e)) + "\n")
    corner = position[tets[:, :4] - 1]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6
    print(f"{len(position)} nodes, {len(tets)} elements, {volume.sum() * 7850:.2f} kg of steel, "
          f"smallest element {volume.min():.2e} m³")
    assert volume.min() > 0


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "lift-boom.inp")
