//! `RUNS.parquet`: one row per run with `run_id`, `payload_kg`, `angle_<name>_rad` and
//! `valve_<name>_ratio` (list of doubles, one per sample).

use anyhow::{Context, bail, ensure};
use arrow::array::{
    Array, ArrayRef, AsArray, Float64Array, Float64Builder, ListBuilder, RecordBatch, UInt64Array,
};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Float64Type, UInt64Type};
use hydroflex_dataset::guard;
use hydroflex_openapi::machine::MachineFile;
use hydroflex_sim::trajectory::RunInput;
use parquet::arrow::ArrowWriter;
use std::collections::BTreeSet;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

/// Reads the table and checks every value; runs are sorted by `run_id`.
///
/// # Errors
/// Names the column, the row and the value at fault.
pub(super) fn read(path: &Path, machine: &MachineFile) -> anyhow::Result<Vec<RunInput>> {
    let file = File::open(path).with_context(|| format!("run table {}", path.display()))?;
    let reader = guard::open_parquet(file)
        .and_then(guard::batches)
        .with_context(|| format!("{} is not a Parquet file", path.display()))?;
    let mut runs = Vec::new();
    for batch in reader {
        let batch = batch.with_context(|| format!("{} is damaged", path.display()))?;
        let first_row = runs.len();
        let of_batch = Columns::new(&batch, machine)?.runs(first_row)?;
        runs.extend(of_batch);
    }
    ensure!(!runs.is_empty(), "run table {} has no rows", path.display());
    runs.sort_by_key(|run: &RunInput| run.run_id);
    if let Some(pair) = runs.windows(2).find(|pair| pair[0].run_id == pair[1].run_id) {
        bail!(
            "column run_id holds {} twice; every run needs its own",
            pair[0].run_id
        );
    }
    Ok(runs)
}

/// Writes runs as a table that [`read`] and other tools take.
///
/// # Errors
/// The file cannot be written.
pub(crate) fn write(path: &Path, machine: &MachineFile, runs: &[RunInput]) -> anyhow::Result<()> {
    let angle = |a: usize| -> ArrayRef {
        Arc::new(Float64Array::from_iter_values(
            runs.iter().map(|run| run.angles_rad[a]),
        ))
    };
    let valve = |v: usize| -> ArrayRef {
        let mut lists = ListBuilder::new(Float64Builder::new());
        for run in runs {
            lists.values().append_slice(&run.valves_ratio[v]);
            lists.append(true);
        }
        Arc::new(lists.finish())
    };
    let run_ids: ArrayRef = Arc::new(UInt64Array::from_iter_values(runs.iter().map(|run| run.run_id)));
    let payloads: ArrayRef = Arc::new(Float64Array::from_iter_values(
        runs.iter().map(|run| run.payload_kg),
    ));
    let mut columns = vec![
        ("run_id".to_owned(), run_ids),
        ("payload_kg".to_owned(), payloads),
    ];
    let angles = names("angle", &machine.angles, "rad", |a| &a.name);
    columns.extend(angles.into_iter().enumerate().map(|(a, name)| (name, angle(a))));
    let valves = names("valve", &machine.cylinders, "ratio", |c| &c.name);
    columns.extend(valves.into_iter().enumerate().map(|(v, name)| (name, valve(v))));
    let batch = RecordBatch::try_from_iter(columns).context("run table")?;
    let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    let mut writer = ArrowWriter::try_new(file, batch.schema(), None).context("run table")?;
    writer.write(&batch).context("run table")?;
    writer.close().context("run table")?;
    Ok(())
}

/// The columns of a batch, of the right types and without nulls.
struct Columns {
    run_id: UInt64Array,
    payload_kg: Float64Array,
    payload_allowed: bool,
    angles: Vec<(String, Float64Array)>,
    valves: Vec<(String, ArrayRef)>,
}

impl Columns {
    fn new(batch: &RecordBatch, machine: &MachineFile) -> anyhow::Result<Self> {
        let angles: Vec<String> = names("angle", &machine.angles, "rad", |a| &a.name);
        let valves: Vec<String> = names("valve", &machine.cylinders, "ratio", |c| &c.name);
        let mut known: BTreeSet<&str> = ["run_id", "payload_kg"].into();
        known.extend(angles.iter().chain(&valves).map(String::as_str));
        for field in batch.schema().fields() {
            let name = field.name().as_str();
            ensure!(
                known.contains(name),
                "column {name} is not known for machine {}; allowed are {}",
                machine.name,
                known.iter().copied().collect::<Vec<_>>().join(", ")
            );
        }
        let floats = |name: String| {
            let array = column(batch, &name, &DataType::Float64)?;
            Ok((name, array.as_primitive::<Float64Type>().clone()))
        };
        let list = DataType::new_list(DataType::Float64, true);
        Ok(Self {
            run_id: column(batch, "run_id", &DataType::UInt64)?
                .as_primitive::<UInt64Type>()
                .clone(),
            payload_kg: floats("payload_kg".to_owned())?.1,
            payload_allowed: machine.payload.is_some(),
            angles: angles.into_iter().map(floats).collect::<anyhow::Result<_>>()?,
            valves: valves
                .into_iter()
                .map(|name| Ok((name.clone(), column(batch, &name, &list)?)))
                .collect::<anyhow::Result<_>>()?,
        })
    }

    fn runs(&self, first_row: usize) -> anyhow::Result<Vec<RunInput>> {
        (0..self.run_id.len())
            .map(|row| {
                self.run(row)
                    .with_context(|| format!("row {} (run_id {})", first_row + row, self.run_id.value(row)))
            })
            .collect()
    }

    fn run(&self, row: usize) -> anyhow::Result<RunInput> {
        let payload_kg = self.payload_kg.value(row);
        ensure!(
            payload_kg.is_finite() && payload_kg >= 0.0,
            "payload_kg is {payload_kg}, allowed is 0 or more"
        );
        ensure!(
            self.payload_allowed || payload_kg == 0.0,
            "payload_kg is {payload_kg}, but the machine carries no payload: allowed is 0"
        );
        let mut angles_rad = Vec::new();
        for (name, values) in &self.angles {
            let angle = values.value(row);
            ensure!(
                (-std::f64::consts::PI..=std::f64::consts::PI).contains(&angle),
                "{name} is {angle}, allowed are radians from −π to π"
            );
            angles_rad.push(angle);
        }
        let mut valves_ratio: Vec<Vec<f64>> = Vec::new();
        for (name, lists) in &self.valves {
            let values = lists.as_list::<i32>().value(row);
            let values = values.as_primitive::<Float64Type>();
            ensure!(values.null_count() == 0, "{name} has an empty value in its list");
            let signal = values.values().to_vec();
            ensure!(!signal.is_empty(), "{name} has no values, at least one is needed");
            if let Some(k) = signal.iter().position(|u| !(-1.0..=1.0).contains(u)) {
                bail!("{name}[{k}] is {}, allowed is −1 to 1", signal[k]);
            }
            if let Some(first) = valves_ratio.first() {
                ensure!(
                    first.len() == signal.len(),
                    "{name} has {} values, {} has {}: all signals of a run need the same number",
                    signal.len(),
                    self.valves[0].0,
                    first.len()
                );
            }
            valves_ratio.push(signal);
        }
        Ok(RunInput {
            run_id: self.run_id.value(row),
            payload_kg,
            angles_rad,
            valves_ratio,
        })
    }
}

fn names<T>(family: &str, items: &[T], unit: &str, name: impl Fn(&T) -> &String) -> Vec<String> {
    items
        .iter()
        .map(|item| format!("{family}_{}_{unit}", name(item)))
        .collect()
}

/// A column, converted to a type where nothing is lost by it.
fn column(batch: &RecordBatch, name: &str, wanted: &DataType) -> anyhow::Result<ArrayRef> {
    let Some(array) = batch.column_by_name(name) else {
        let fields = batch.schema();
        let found: Vec<&str> = fields.fields().iter().map(|f| f.name().as_str()).collect();
        bail!("column {name} is missing; found are {}", found.join(", "));
    };
    let from = array.data_type();
    ensure!(
        fits(from, wanted),
        "column {name} has type {from}, needed is {wanted}"
    );
    if let Some(row) = (0..array.len()).find(|&row| array.is_null(row)) {
        bail!("column {name} is empty in row {row}");
    }
    let converted = cast(array, wanted).with_context(|| format!("column {name}"))?;
    match (0..converted.len()).find(|&row| converted.is_null(row)) {
        // cast makes nulls of what does not fit: a negative run_id
        Some(row) => bail!("column {name} has a value in row {row} that is no {wanted}"),
        None => Ok(converted),
    }
}

fn fits(from: &DataType, wanted: &DataType) -> bool {
    match (from, wanted) {
        (DataType::List(from) | DataType::LargeList(from), DataType::List(wanted)) => {
            fits(from.data_type(), wanted.data_type())
        }
        (from, DataType::UInt64) => from.is_integer(),
        (from, DataType::Float64) => from.is_floating() || from.is_integer(),
        (from, wanted) => from == wanted,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use arrow::array::Int64Array;
    use arrow::datatypes::{Field, Schema};
    use hydroflex_sim::machine::Machine;

    struct Row(i64, f64, f64, Vec<f64>);

    fn table(rows: &[Row], angle: &str) -> tempfile::NamedTempFile {
        let mut valves = ListBuilder::new(Float64Builder::new());
        for Row(.., signal) in rows {
            valves.values().append_slice(signal);
            valves.append(true);
        }
        let valves = valves.finish();
        let fields = vec![
            Field::new("run_id", DataType::Int64, false),
            Field::new("payload_kg", DataType::Float64, false),
            Field::new(angle, DataType::Float64, false),
            Field::new("valve_lift_ratio", valves.data_type().clone(), false),
        ];
        let floats = |of: fn(&Row) -> f64| Arc::new(Float64Array::from_iter_values(rows.iter().map(of)));
        let columns: Vec<ArrayRef> = vec![
            Arc::new(Int64Array::from_iter_values(rows.iter().map(|row| row.0))),
            floats(|row| row.1),
            floats(|row| row.2),
            Arc::new(valves),
        ];
        let schema = Arc::new(Schema::new(fields));
        let batch = RecordBatch::try_new(Arc::clone(&schema), columns).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut writer = ArrowWriter::try_new(file.reopen().unwrap(), schema, None).unwrap();
        writer.write(&batch).unwrap();
        writer.close().unwrap();
        file
    }

    fn read_rows(rows: &[Row]) -> anyhow::Result<Vec<RunInput>> {
        let text = Machine::built_in_text("lift-boom-published").unwrap();
        let machine = Machine::parse_file(text).unwrap();
        read(table(rows, "angle_lift_rad").path(), &machine)
    }

    fn refusal(rows: &[Row]) -> String {
        format!("{:#}", read_rows(rows).unwrap_err())
    }

    #[test]
    fn runs_of_different_length_stand_in_one_table() {
        let rows = [Row(7, 50.0, 0.1, vec![1.0; 5]), Row(3, 0.0, 0.2, vec![-1.0; 2])];
        let runs = read_rows(&rows).unwrap();
        assert_eq!(runs.iter().map(|run| run.run_id).collect::<Vec<_>>(), [3, 7]);
        assert_eq!(runs[1].valves_ratio, [vec![1.0; 5]]);
        assert_eq!(runs[0].angles_rad, [0.2]);
    }

    #[test]
    fn a_wrong_value_is_named_with_row_and_column() {
        let good = || Row(0, 0.0, 0.0, vec![0.0]);
        let wrong = |row| refusal(&[good(), row]);
        assert_eq!(
            wrong(Row(1, 0.0, 0.0, vec![0.0, 1.5])),
            "row 1 (run_id 1): valve_lift_ratio[1] is 1.5, allowed is −1 to 1"
        );
        assert_eq!(
            wrong(Row(1, -2.0, 0.0, vec![0.0])),
            "row 1 (run_id 1): payload_kg is -2, allowed is 0 or more"
        );
        assert_eq!(
            wrong(Row(1, 0.0, 20.0, vec![0.0])),
            "row 1 (run_id 1): angle_lift_rad is 20, allowed are radians from −π to π"
        );
        assert_eq!(
            wrong(Row(1, 0.0, 0.0, vec![])),
            "row 1 (run_id 1): valve_lift_ratio has no values, at least one is needed"
        );
        assert_eq!(
            wrong(good()),
            "column run_id holds 0 twice; every run needs its own"
        );
        assert!(wrong(Row(-1, 0.0, 0.0, vec![0.0])).contains("column run_id has a value in row 1"));
    }

    #[test]
    fn a_missing_or_unknown_column_is_named() {
        let text = Machine::built_in_text("lift-boom-published").unwrap();
        let machine = Machine::parse_file(text).unwrap();
        let file = table(&[Row(0, 0.0, 0.0, vec![0.0])], "angle_lift_deg");
        let error = read(file.path(), &machine).unwrap_err().to_string();
        assert!(error.starts_with("column angle_lift_deg is not known"), "{error}");
        assert!(error.contains("angle_lift_rad"), "{error}");
    }
}
