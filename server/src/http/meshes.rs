//! `/v1/meshes`: meshes that jobs may give to their machines, addressed by content.

use super::AppState;
use super::error::ApiError;
use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{FromRequest, Request, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use hydroflex_ledger::blobs::mesh_key;
use hydroflex_openapi::catalogue::MeshInfo;
use hydroflex_openapi::problem::{FieldError, Problem};
use hydroflex_sim::fe::{MeshError, read_abaqus};
use sha2::{Digest, Sha256};

/// Largest mesh: some 600,000 nodes of quadratic tetrahedra.
pub const MESH_LIMIT_BYTES: usize = 128 << 20;

/// Upload a mesh
///
/// The body is an Abaqus `.inp` file with C3D4 or C3D10 elements, whatever its media type. It is read and checked
/// whole; the answer's `mesh_sha256` is what a job writes into `meshes`. The same file again changes nothing.
#[utoipa::path(
    post, path = "/v1/meshes", tag = "machines", operation_id = "upload_mesh",
    request_body(content = String, content_type = "text/plain", description = "Abaqus .inp file"),
    responses(
        (status = 201, description = "Stored", body = MeshInfo),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn upload(State(state): State<AppState>, mesh: MeshBody) -> Result<Response, ApiError> {
    let content = mesh.0;
    let bytes = content.clone();
    // A second or so for a large one: not on the threads that answer everybody.
    let info = tokio::task::spawn_blocking(move || inspect(&bytes))
        .await
        .map_err(|panic| ApiError::Internal(panic.to_string()))??;
    let key = mesh_key(&info.mesh_sha256).ok_or_else(|| ApiError::Internal("a hash is no key".to_owned()))?;
    match state.blobs().create(&key, content).await {
        Ok(()) => tracing::info!(mesh = info.mesh_sha256, bytes = info.size_bytes, "mesh stored"),
        Err(error) if error.is_already_there() => {}
        Err(error) => return Err(error.into()),
    }
    Ok((StatusCode::CREATED, Json(info)).into_response())
}

fn inspect(content: &[u8]) -> Result<MeshInfo, ApiError> {
    let text = std::str::from_utf8(content).map_err(|error| {
        ApiError::field(
            FieldError::new("", format!("byte {} is not text", error.valid_up_to()))
                .allowed("an Abaqus .inp file in UTF-8 or ASCII"),
        )
    })?;
    let mesh = read_abaqus(text).map_err(|error: MeshError| {
        ApiError::field(
            FieldError::new("", error.to_string())
                .allowed("an Abaqus .inp file with one part of C3D4 or C3D10 elements"),
        )
    })?;
    Ok(MeshInfo {
        mesh_sha256: hex::encode(Sha256::digest(content)),
        size_bytes: content.len() as u64,
        nodes: mesh.node_count() as u64,
        elements: mesh.elements().len() as u64,
        element_kind: mesh.elements().kind_name().to_owned(),
        volume_m3: mesh.volume_m3(),
        node_sets: mesh.node_set_names().map(str::to_owned).collect(),
    })
}

/// The bytes of a mesh.
pub struct MeshBody(Bytes);

impl<S: Send + Sync> FromRequest<S> for MeshBody {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        let multipart = request
            .headers()
            .get(header::CONTENT_TYPE)
            .and_then(|value| value.to_str().ok())
            .is_some_and(|value| value.starts_with("multipart/"));
        if multipart {
            return Err(ApiError::MediaType(
                "the file itself is the body (curl --data-binary @FILE), not a form".to_owned(),
            ));
        }
        Bytes::from_request(request, state)
            .await
            .map(Self)
            .map_err(|rejection: BytesRejection| {
                if rejection.status() == StatusCode::PAYLOAD_TOO_LARGE {
                    ApiError::TooLarge {
                        limit_bytes: MESH_LIMIT_BYTES as u64,
                    }
                } else {
                    ApiError::Malformed(rejection.body_text())
                }
            })
    }
}
