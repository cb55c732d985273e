//! What other programs take for one training step on the scene files, so that our figures stand beside theirs.

use super::scene::SceneSize;

/// One training step of the peers at SH 3, milliseconds.
pub(crate) struct PeerStep {
    gaussians: usize,
    image: (u32, u32),
    /// OpenSplat 15b7e80 `--cpu` on libtorch 2.15, its depth sort mended, Adam included: on one thread and on two.
    opensplat: [Option<f64>; 2],
    /// Brush 8b7f5c6 on lavapipe (Mesa 22.3.6), `SplatTrainer::step`: on one thread and on two.
    brush: [Option<f64>; 2],
}

/// Where and how the figures were taken.
pub(crate) const MEASURED_ON: &str = "peers: 2 vCPU Sapphire Rapids (about 2.5 GHz, AVX-512), nothing else running; median of 5 (OpenSplat, its depth sort mended) and 3 (Brush)";

const fn peer(
    gaussians: usize,
    image: (u32, u32),
    opensplat: (f64, f64),
    brush: [Option<f64>; 2],
) -> PeerStep {
    PeerStep { gaussians, image, opensplat: [Some(opensplat.0), Some(opensplat.1)], brush }
}

const STEPS: [PeerStep; 6] = [
    peer(10_000, (320, 180), (310.0, 301.0), [Some(1312.0), Some(1008.0)]),
    peer(50_000, (320, 180), (469.0, 452.0), [None, Some(2315.0)]),
    peer(100_000, (320, 180), (644.0, 637.0), [None, Some(2717.0)]),
    peer(10_000, (640, 360), (1214.0, 1496.0), [None, Some(2071.0)]),
    peer(50_000, (640, 360), (1439.0, 2020.0), [None, None]),
    peer(100_000, (640, 360), (1805.0, 3014.0), [None, Some(4123.0)]),
];

/// OpenSplat's and Brush's step on a scene file of this size.
pub(crate) fn steps(size: SceneSize, threads: usize) -> (Option<f64>, Option<f64>) {
    let is_same =
        |peer: &&PeerStep| peer.gaussians == size.gaussians && peer.image == (size.width, size.height);
    let Some(peer) = STEPS.iter().find(is_same).filter(|_| size.sh_degree == 3) else {
        return (None, None);
    };
    let at = |times: &[Option<f64>; 2]| times.get(threads.wrapping_sub(1)).copied().flatten();
    (at(&peer.opensplat), at(&peer.brush))
}
