//! What the reader accepts, and with which words it refuses.

use super::*;
use proptest::prelude::*;
use std::fmt::Write;

const UNIT: &str = "*Heading\n a title, with a comma\n** comment\n*Part, name=A\n*Node, nset=all\n\
    10, 0., 0., 0.\n 20, 1.0d0, 0, 0\n30, 0, 1, 0\n40, 0, 0, 1\n50, 1., 1, 1e0,\n\
    *Element, type=C3D4,\n elset=Solid\n7, 10, 20, 30, 40\n9, 20,\n 50, 30,\n 40\n*End Part\n\
    *Nset, nset=odd, generate\n10, 50, 20\n*NSET, NSET=Some\n20, 30\nodd\n*Elset, elset=E\n9\n\
    *Instance, name=A-1, part=A\n*End Instance\n*Material, name=x\n*Density\n7850.,\n";

#[test]
fn nodes_elements_and_sets_are_read_in_file_order() {
    let mesh = read_abaqus(UNIT).unwrap();
    assert_eq!(mesh.node_count(), 5);
    assert_eq!(mesh.elements(), &Elements::Tet4(vec![[0, 1, 2, 3], [1, 4, 2, 3]]));
    assert_eq!(mesh.node_set("ODD"), Some(&[0, 2, 4][..]));
    assert_eq!(mesh.node_set("some"), Some(&[0, 1, 2, 4][..]));
    assert_eq!(mesh.node_set("all").map(<[u32]>::len), Some(5));
    assert_eq!(mesh.element_set("solid"), Some(&[0, 1][..]));
    assert_eq!(mesh.element_set("e"), Some(&[1][..]));
    assert_eq!(mesh.node_set("nothing"), None);
}

fn refusal(text: &str) -> String {
    read_abaqus(text).unwrap_err().to_string()
}

#[test]
fn refusals_name_the_line_and_the_reason() {
    let edit = |from: &str, to: &str| refusal(&UNIT.replace(from, to));
    assert_eq!(
        edit("30, 0, 1, 0\n", "30, 0, one, 0\n"),
        "line 8: `one` is not a finite coordinate"
    );
    assert_eq!(
        edit("30, 0, 1, 0\n", "30, 0, 1\n"),
        "line 8: 3 entries where a label and three coordinates are needed"
    );
    assert_eq!(
        edit("30, 0, 1, 0\n", "20, 0, 1, 0\n"),
        "line 8: node 20 is defined twice"
    );
    assert_eq!(
        edit("7, 10, 20, 30, 40", "7, 10, 20, 30, 41"),
        "line 13: node 41 is not defined"
    );
    assert_eq!(
        edit("7, 10, 20, 30, 40", "7, 10, 20, 30"),
        "line 13: the element is cut off: 4 of 5 numbers"
    );
    assert!(edit("C3D4", "C3D8R").starts_with("line 11: element type `C3D8R` is not read"));
    assert_eq!(edit("*Elset, elset=E", "*Elset"), "line 23: *ELSET needs ELSET=…");
    assert_eq!(
        edit("20, 30\nodd", "20, 30\neven"),
        "line 22: set `even` is not defined before this line"
    );
    assert_eq!(
        edit("*Elset, elset=E", "*Elset, elset="),
        "line 23: *ELSET needs ELSET=…"
    );
    assert_eq!(edit("20, 30\nodd", "20, 31"), "line 21: node 31 is not defined");
    assert_eq!(
        edit("part=A\n", "part=A\n0., 0., 1.\n"),
        "line 26: the instance is translated or rotated; export the part in its own frame"
    );
    assert_eq!(
        edit("*Part, name=A", "*Include, input=secret"),
        "line 4: *INCLUDE is not read"
    );
    assert_eq!(
        edit("10, 50, 20", "50, 10, 20"),
        "line 19: GENERATE range 50, 10, 20 is empty or has no step"
    );
    assert_eq!(refusal("1, 2\n"), "line 1: data before the first keyword");
    assert_eq!(refusal(""), "the file has no *NODE data");
    assert!(edit("7, 10, 20, 30, 40", "7, 20, 10, 30, 40").starts_with("element 7 is inverted or flat"));
    assert_eq!(
        edit("9, 20,\n 50, 30", "9, 10,\n 20, 30"),
        "node 50 belongs to no element (1 such nodes)"
    );
}

#[test]
fn a_mesh_in_two_pieces_is_refused() {
    let mut text = "*NODE\n".to_owned();
    for part in 0..2 {
        for (i, x) in ["0, 0, 0", "1, 0, 0", "0, 1, 0", "0, 0, 1"].iter().enumerate() {
            writeln!(text, "{}, {x}", 10 * part + i + 1).unwrap();
        }
    }
    text += "*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n2, 11, 12, 13, 14\n";
    let mesh = read_abaqus(&text).unwrap();
    let defect = mesh.check_connected(&[]).unwrap_err();
    assert_eq!(
        defect.to_string(),
        "the mesh falls into 2 parts that share no node; one of 1 elements holds element 1"
    );
    // pins through both hold them, three nodes each; two nodes do not
    assert_eq!(mesh.check_connected(&[&[0, 1, 2, 5, 6, 7]]), Ok(()));
    assert_eq!(mesh.check_connected(&[&[0, 1, 2, 5, 6]]), Err(defect));
}

proptest! {
    #[test]
    fn garbage_never_panics(text in "(\\*(node|element|nset|elset|instance)?(, ?(type=c3d4|type=c3d10|nset=a|elset=a|generate))*,?\n|[0-9,. eE+-]{0,30}\n|.{0,20}\n){0,30}") {
        let _ = read_abaqus(&text);
    }

    #[test]
    fn a_damaged_file_never_panics(at in 0..UNIT.len(), replacement in ".{0,3}", cut in 0..4_usize) {
        let end = (at + cut).min(UNIT.len());
        let _ = read_abaqus(&format!("{}{replacement}{}", &UNIT[..at], &UNIT[end..]));
    }
}

/// Found by a fuzzer: a set that holds itself doubled with every line.
#[test]
fn sets_that_hold_each_other_many_times_cost_no_memory() {
    let itself = UNIT.replace("20, 30\nodd", &format!("20, 30\n{}", "Some\n".repeat(60)));
    let mesh = read_abaqus(&itself).unwrap();
    assert_eq!(mesh.node_set("some"), Some(&[1, 2][..]));
    // Each set holds the one before twice: 2^60 members.
    let mut chain = String::from("20, 30\n");
    for set in 0..60 {
        let before = if set == 0 {
            "Some".to_owned()
        } else {
            format!("s{}", set - 1)
        };
        writeln!(chain, "*Nset, nset=s{set}\n{before}, {before}").unwrap();
    }
    let error = refusal(&UNIT.replace("20, 30\nodd\n", &chain));
    assert!(
        error.ends_with("sets have more than 8000000 members from other sets or ranges"),
        "{error}"
    );
}
