//! `metrics.csv`: a row per finished frame and held-out view, for spreadsheets and plots.

use splat::frame::ViewMetrics;

use super::{AssembledFrame, AssemblyError, METRICS};

const HEADER: [&str; 8] = [
    "frame",
    "view",
    "psnr_before",
    "ssim_before",
    "moving_psnr_before",
    "psnr_after",
    "ssim_after",
    "moving_psnr_after",
];

/// The table; PSNR in dB, empty where the clip has no moving region. The view `mean` is the mean over views.
pub(super) fn csv(frames: &[AssembledFrame]) -> Result<Vec<u8>, AssemblyError> {
    let failed = |reason: String| AssemblyError::Encode { file: METRICS, reason };
    let mut table = csv::Writer::from_writer(Vec::new());
    table.write_record(HEADER).map_err(|error| failed(error.to_string()))?;
    for frame in frames {
        let Some(report) = &frame.report else { continue };
        for after in &report.after {
            let before = report.before.iter().find(|before| before.view == after.view);
            let mut row = vec![frame.number.to_string(), after.view.clone()];
            row.extend(before.map_or_else(Default::default, columns));
            row.extend(columns(after));
            table.write_record(row).map_err(|error| failed(error.to_string()))?;
        }
    }
    table.into_inner().map_err(|error| failed(error.to_string()))
}

fn columns(metrics: &ViewMetrics) -> [String; 3] {
    let moving = metrics.moving_psnr.map(|value| format!("{value:.4}")).unwrap_or_default();
    [format!("{:.4}", metrics.psnr), format!("{:.6}", metrics.ssim), moving]
}
