"""Builds the mesh of the built-in lift boom from parameters.toml.

    pip install gmsh==4.15.2
    python build_mesh.py            # writes lift-boom.inp beside this file
    python build_mesh.py 0.5 /tmp/finer.inp   # half the element size, for a convergence check

The boom is a closed box of two webs and a folded flange, with diaphragms and three cross tubes, one
solid, meshed with quadratic tetrahedra (C3D10) whose midside nodes lie on the bores.
"""

import math
import pathlib
import sys
import tomllib

import gmsh

HERE = pathlib.Path(__file__).parent
DIGITS = 8  # 0.01 µm, far below a tolerance of manufacture; keeps the file small


def offset_inwards(outline, distance):
    """Moves every edge of an anticlockwise polygon inwards."""
    edges = []
    for (x0, y0), (x1, y1) in zip(outline, outline[1:] + outline[:1]):
        length = math.hypot(x1 - x0, y1 - y0)
        tx, ty = (x1 - x0) / length, (y1 - y0) / length
        edges.append(((x0 - ty * distance, y0 + tx * distance), (tx, ty)))
    corners = []
    for (p, t), (q, s) in zip(edges[-1:] + edges[:-1], edges):
        # p + a t = q + b s
        determinant = t[0] * -s[1] + s[0] * t[1]
        a = ((q[0] - p[0]) * -s[1] + s[0] * (q[1] - p[1])) / determinant
        corners.append((p[0] + a * t[0], p[1] + a * t[1]))
    return corners


def prism(occ, outline, z0, z1):
    points = [occ.addPoint(x, y, z0) for x, y in outline]
    lines = [occ.addLine(a, b) for a, b in zip(points, points[1:] + points[:1])]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    solids = [e for e in occ.extrude([(2, face)], 0, 0, z1 - z0) if e[0] == 3]
    return solids


def tube_solid(occ, tube, radius):
    x, y = tube["centre_m"]
    z = tube["half_length_m"]
    return (3, occ.addCylinder(x, y, -z, 0, 0, 2 * z, radius))


def geometry(occ, p):
    w = p["half_width_m"]
    box = prism(occ, p["outline_m"], -w, w)
    inner_outline = offset_inwards([tuple(c) for c in p["outline_m"]], p["flange_thickness_m"])
    inner_w = w - p["web_thickness_m"]
    cavity = prism(occ, inner_outline, -inner_w, inner_w)
    plates = []
    t = p["diaphragm_thickness_m"]
    for x in p["diaphragms_x_m"]:
        slab = (3, occ.addBox(x - t / 2, -1, -1, t, 2, 2))
        plate, _ = occ.intersect(occ.copy(cavity), [slab])
        plates += plate
    shell, _ = occ.cut(box, cavity)
    tubes = [tube_solid(occ, tube, tube["outer_radius_m"]) for tube in p["tube"]]
    solid, _ = occ.fuse(shell, plates + tubes)
    bores = [tube_solid(occ, tube, tube["bore_radius_m"]) for tube in p["tube"]]
    solid, _ = occ.cut(solid, bores)
    points = [(0, occ.addPoint(*point["at_m"])) for point in p["point"]]
    occ.fragment(solid, points)
    occ.synchronize()


def sizes(p, factor):
    """Plates get `size_m`; around each bore the size follows the number of segments."""
    field = gmsh.model.mesh.field
    size = p["mesh"]["size_m"] * factor
    local = []
    for tube in p["tube"]:
        x, y = tube["centre_m"]
        fine = factor * 2 * math.pi * tube["bore_radius_m"] / p["mesh"]["bore_segments"]
        i = field.add("MathEval")
        reach = f"Max(0, Sqrt((x-({x}))^2+(y-({y}))^2)-{tube['outer_radius_m']})"
        field.setString(i, "F", f"{fine} + {p['mesh']['growth']}*{reach}")
        local.append(i)
    i = field.add("MathEval")
    field.setString(i, "F", f"{size}")
    minimum = field.add("Min")
    field.setNumbers(minimum, "FieldsList", local + [i])
    field.setAsBackgroundMesh(minimum)


def write(path):
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    _, labels, _ = gmsh.model.mesh.getElements(3)
    quality = gmsh.model.mesh.getElementQualities(labels[0], "minSJ")
    print(f"smallest scaled Jacobian {min(quality):.3f}, below 0.1: {sum(quality < 0.1)}")
    position = {int(t): coordinates[3 * i : 3 * i + 3] for i, t in enumerate(tags)}
    types, labels, nodes = gmsh.model.mesh.getElements(3)
    assert list(types) == [11], "only tetrahedra with 10 nodes"
    elements = nodes[0].reshape(-1, 10)
    # gmsh counts the last two midside nodes the other way round than Abaqus
    elements = elements[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    used = sorted({int(n) for n in elements.flat})
    number = {tag: i + 1 for i, tag in enumerate(used)}

    def text(x):
        return f"{x:.{DIGITS}f}".rstrip("0").rstrip(".").replace("-0.", "-.").lstrip("0") or "0"

    lines = ["*HEADING", "hydroflex lift boom, made by build_mesh.py", "*NODE"]
    for tag in used:
        lines.append(f"{number[tag]}," + ",".join(text(x) for x in position[tag]))
    lines.append("*ELEMENT,TYPE=C3D10")
    for i, element in enumerate(elements):
        lines.append(f"{i + 1}," + ",".join(str(number[int(n)]) for n in element))
    path.write_text("\n".join(lines) + "\n")
    print(f"{path.name}: {len(used)} nodes, {len(elements)} elements, {path.stat().st_size} bytes")


def main():
    factor = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    path = pathlib.Path(sys.argv[2]) if len(sys.argv) > 2 else HERE / "lift-boom.inp"
    p = tomllib.loads((HERE / "parameters.toml").read_text())
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 2)
    gmsh.option.setNumber("General.NumThreads", 1)
    gmsh.option.setNumber("Mesh.RandomFactor", 1e-9)
    gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)
    gmsh.option.setNumber("Mesh.MeshSizeFromPoints", 0)
    gmsh.option.setNumber("Mesh.Algorithm", 6)
    gmsh.option.setNumber("Mesh.Optimize", 1)
    gmsh.option.setNumber("Mesh.OptimizeNetgen", 1)
    gmsh.option.setNumber("Mesh.ElementOrder", 2)
    gmsh.option.setNumber("Mesh.HighOrderOptimize", 1)
    gmsh.model.add("lift-boom")
    geometry(gmsh.model.occ, p)
    sizes(p, factor)
    gmsh.model.mesh.generate(3)
    write(path)
    gmsh.finalize()


if __name__ == "__main__":
    main()
