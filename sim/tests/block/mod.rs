//! A block of tetrahedra as Abaqus text.

use std::collections::BTreeMap;
use std::fmt::Write;

/// Edges of the block, m.
pub(crate) const SIZE_M: [f64; 3] = [1.0, 0.1, 0.05];

/// A grid of cells, six tetrahedra each around the diagonal, with or without midside nodes, as
/// Abaqus text with the node sets LEFT (x = 0) and RIGHT (x = 1 m).
pub(crate) fn block_text(cells: [usize; 3], quadratic: bool) -> String {
    // nodes sit on a grid of half cells, so that midside nodes have whole numbers too
    let mut numbers: BTreeMap<[usize; 3], usize> = BTreeMap::new();
    let mut elements = String::new();
    let mut count = 0;
    for i in 0..cells[0] {
        for j in 0..cells[1] {
            for k in 0..cells[2] {
                for [a, b, c] in [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]] {
                    let mut corner = [2 * i, 2 * j, 2 * k];
                    let mut corners = vec![corner];
                    for axis in [a, b, c] {
                        corner[axis] += 2;
                        corners.push(corner);
                    }
                    let even = [[0, 1, 2], [1, 2, 0], [2, 0, 1]].contains(&[a, b, c]);
                    if !even {
                        corners.swap(1, 2);
                    }
                    let mut nodes = corners.clone();
                    if quadratic {
                        for [m, n] in [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]] {
                            nodes.push(std::array::from_fn(|x| {
                                usize::midpoint(corners[m][x], corners[n][x])
                            }));
                        }
                    }
                    count += 1;
                    write!(elements, "{count}").unwrap();
                    for node in nodes {
                        let next = numbers.len() + 1;
                        write!(elements, ", {}", numbers.entry(node).or_insert(next)).unwrap();
                    }
                    elements.push('\n');
                }
            }
        }
    }
    let mut text = "*NODE\n".to_owned();
    let (mut left, mut right) = (Vec::new(), Vec::new());
    for (node, number) in &numbers {
        let x: Vec<f64> = (0..3)
            .map(|c| SIZE_M[c] * node[c] as f64 / (2 * cells[c]) as f64)
            .collect();
        writeln!(text, "{number}, {}, {}, {}", x[0], x[1], x[2]).unwrap();
        if node[0] == 0 {
            left.push(number.to_string());
        }
        if node[0] == 2 * cells[0] {
            right.push(number.to_string());
        }
    }
    let kind = if quadratic { "C3D10" } else { "C3D4" };
    writeln!(text, "*ELEMENT, TYPE={kind}\n{elements}*NSET, NSET=LEFT").unwrap();
    writeln!(
        text,
        "{}\n*NSET, NSET=RIGHT\n{}",
        left.join(",\n"),
        right.join(",\n")
    )
    .unwrap();
    text
}
