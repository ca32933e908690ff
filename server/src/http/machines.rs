//! `/v1/machines`: what can be simulated.

use super::AppState;
use super::error::ApiError;
use super::extract::Id;
use axum::Json;
use axum::extract::State;
use hydroflex_openapi::catalogue::{MachineInfo, MachineList};
use hydroflex_openapi::problem::Problem;

/// List the machines that the service carries
#[utoipa::path(
    get, path = "/v1/machines", tag = "machines", operation_id = "list_machines",
    responses(
        (status = 200, description = "Machines", body = MachineList),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn list(State(state): State<AppState>) -> Json<MachineList> {
    Json(MachineList {
        machines: state.coordinator().machines(),
    })
}

/// Show a machine with its file
#[utoipa::path(
    get, path = "/v1/machines/{name}", tag = "machines", operation_id = "show_machine",
    params(("name" = String, Path)),
    responses(
        (status = 200, description = "The machine", body = MachineInfo),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn show(
    State(state): State<AppState>,
    Id(name): Id<String>,
) -> Result<Json<MachineInfo>, ApiError> {
    let machine = state
        .coordinator()
        .machines()
        .into_iter()
        .find(|machine| machine.name == name);
    machine
        .map(Json)
        .ok_or_else(|| ApiError::NotFound(format!("no machine {name:?}")))
}
