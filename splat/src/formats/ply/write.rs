//! Writing the Inria layout.

use super::parameter_names;
use crate::gaussians::Gaussians;

/// The set as a binary little-endian PLY; reading it back gives the same bits. All arrays must have the same number
/// of Gaussians ([`crate::gaussians::validate`]).
pub fn write_ply(gaussians: &Gaussians) -> Vec<u8> {
    let names = parameter_names(gaussians.sh_degree);
    let normals = ["nx", "ny", "nz"].map(String::from);
    let mut bytes =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", gaussians.len()).into_bytes();
    for name in names[..3].iter().chain(&normals).chain(&names[3..]) {
        bytes.extend(format!("property float {name}\n").as_bytes());
    }
    bytes.extend(b"end_header\n");

    let rest = gaussians.sh_coefficients() - 1;
    bytes.reserve(gaussians.len() * (names.len() + 3) * 4);
    let mut put = |values: &[f32]| values.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    for index in 0..gaussians.len() {
        let harmonics = gaussians.sh_of(index);
        put(&gaussians.means[index]);
        put(&[0.0; 3]);
        put(&harmonics[..3]);
        for channel in 0..3 {
            for coefficient in 0..rest {
                put(&[harmonics[3 * (coefficient + 1) + channel]]);
            }
        }
        put(&[gaussians.logit_opacities[index]]);
        put(&gaussians.log_scales[index]);
        put(&gaussians.rotations[index]);
    }
    bytes
}
