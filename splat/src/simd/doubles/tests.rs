use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::simd::{InstructionSet, Instructions, Simd, simd_kernel};

type Octet = [f64; OCTET];

simd_kernel! { fn exponentials(of: &[Octet], to: &mut [Octet]) = exponentials_kernel }
simd_kernel! { fn logarithms(of: &[Octet], to: &mut [Octet]) = logarithms_kernel }

#[inline(always)]
fn exponentials_kernel<S: Simd>(of: &[Octet], to: &mut [Octet]) {
    for (of, to) in of.iter().zip(to) {
        S::Doubles::load(of).exp().store(to);
    }
}

#[inline(always)]
fn logarithms_kernel<S: Simd>(of: &[Octet], to: &mut [Octet]) {
    for (of, to) in of.iter().zip(to) {
        S::Doubles::load(of).ln().store(to);
    }
}

type Function = fn(Instructions, &[Octet], &mut [Octet]);

fn on(instructions: Instructions, function: Function, of: &[f64]) -> Vec<f64> {
    let mut padded: Vec<Octet> = Vec::new();
    for group in of.chunks(OCTET) {
        padded.push(std::array::from_fn(|lane| group.get(lane).copied().unwrap_or(1.0)));
    }
    let mut found = vec![[0.0; OCTET]; padded.len()];
    function(instructions, &padded, &mut found);
    found.into_flattened()[..of.len()].to_vec()
}

/// Units in the last place of `expected` between it and `found`. The libraries behind `f64::exp` and `f64::ln` are right
/// to less than one unit (glibc: 0.51), which the bounds below contain.
fn units(found: f64, expected: f64) -> f64 {
    let last_place = (expected.abs().next_up() - expected.abs()).max(f64::from_bits(1));
    (found - expected).abs() / last_place
}

fn assert_within(name: &str, function: Function, reference: fn(f64) -> f64, of: &[f64], bound: f64) {
    for instructions in Instructions::available() {
        let found = on(instructions, function, of);
        let mut worst = (0.0, 0.0);
        for (&x, &found) in of.iter().zip(&found) {
            let units = units(found, reference(x));
            assert!(!units.is_nan(), "{name}({x:e}) = {found:e}");
            if units > worst.0 {
                worst = (units, x);
            }
        }
        let (units, x) = worst;
        assert!(units <= bound, "{} {name}({x:e}): {units} units", instructions.set());
    }
}

fn uniform(low: f64, high: f64, count: usize) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    (0..count).map(|_| random.random_range(low..high)).collect()
}

#[test]
fn exp_stays_within_its_bound_over_the_whole_range() {
    // Differences of doubles are whole units: one, and what the reference is off by, are less than the stated two.
    for (low, high) in [(-708.0, 709.78), (-40.0, 40.0), (-1.0, 1.0), (-1e-6, 1e-6)] {
        assert_within("exp", exponentials, f64::exp, &uniform(low, high, 100_000), 1.0);
    }
    // A subnormal has fewer digits; it may be rounded twice.
    assert_within("exp", exponentials, f64::exp, &uniform(-746.0, -708.0, 100_000), 1.0);
}

#[test]
fn exp_of_extremes_is_what_the_library_says() {
    let extremes = [
        0.0,
        -0.0,
        f64::MIN_POSITIVE,
        -f64::from_bits(1),
        1e-17,
        f64::INFINITY,
        f64::NEG_INFINITY,
        f64::MAX,
        f64::MIN,
        709.782_712_893_384,
        709.782_712_893_385,
        710.0,
        -708.5,
        -745.13,
        -745.14,
        -750.0,
        -1e4,
    ];
    for instructions in Instructions::available() {
        for (x, found) in extremes.into_iter().zip(on(instructions, exponentials, &extremes)) {
            let expected = x.exp();
            let is_near = found == expected || units(found, expected) <= 2.0;
            assert!(is_near, "{} exp({x:e}) = {found:e}, not {expected:e}", instructions.set());
        }
        assert!(on(instructions, exponentials, &[f64::NAN, -f64::NAN]).iter().all(|value| value.is_nan()));
    }
}

#[test]
fn ln_stays_within_its_bound_over_the_whole_range() {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let any: Vec<f64> =
        (0..200_000).map(|_| f64::from_bits(random.random_range(1..f64::INFINITY.to_bits()))).collect();
    assert_within("ln", logarithms, f64::ln, &any, 1.0);
    let subnormal: Vec<f64> =
        (0..20_000).map(|_| f64::from_bits(random.random_range(1..f64::MIN_POSITIVE.to_bits()))).collect();
    assert_within("ln", logarithms, f64::ln, &subnormal, 1.0);
    for (low, high) in [(0.0, 1.0), (0.5, 2.0), (0.999, 1.001), (1.0, 1.0 + 1e-12)] {
        assert_within("ln", logarithms, f64::ln, &uniform(low, high, 100_000), 1.0);
    }
}

#[test]
fn ln_of_extremes_is_what_the_library_says() {
    let extremes = [
        1.0,
        f64::from_bits(1),
        f64::MIN_POSITIVE,
        f64::MIN_POSITIVE.next_down(),
        f64::MAX,
        f64::INFINITY,
        0.0,
        -0.0,
        1.0_f64.next_down(),
        1.0_f64.next_up(),
        std::f64::consts::SQRT_2,
        std::f64::consts::SQRT_2.next_down(),
    ];
    for instructions in Instructions::available() {
        for (x, found) in extremes.into_iter().zip(on(instructions, logarithms, &extremes)) {
            let expected = x.ln();
            let is_near = found == expected || units(found, expected) <= 2.0;
            assert!(is_near, "{} ln({x:e}) = {found:e}, not {expected:e}", instructions.set());
        }
        let none = [f64::NAN, -1.0, -f64::from_bits(1), f64::NEG_INFINITY, f64::MIN];
        assert!(on(instructions, logarithms, &none).iter().all(|value| value.is_nan()));
    }
}

#[test]
fn avx512_and_avx2_give_the_same_bytes() {
    let of: Vec<f64> = uniform(-750.0, 720.0, 20_000);
    for (function, of) in
        [(exponentials as Function, of.clone()), (logarithms, of.iter().map(|x| x.abs()).collect())]
    {
        let fused = Instructions::available().filter(|i| i.set() != InstructionSet::Baseline);
        let found: Vec<Vec<u64>> =
            fused.map(|i| on(i, function, &of).into_iter().map(f64::to_bits).collect()).collect();
        assert!(found.windows(2).all(|pair| pair[0] == pair[1]));
    }
}

/// Runs every operation of an instruction set on the same numbers as [`PlainDoubles`].
#[inline(always)]
fn same_as_plain<S: Simd>() {
    let a: Octet = [-3.7, f64::NAN, 0.0, 2.5, f64::INFINITY, -1e300, 7.25, 0.1];
    let b: Octet = [1.3, 2.0, -0.0, f64::NAN, 3.0, 1e300, 7.25, -0.3];
    let run = |operation: &str, fast: S::Doubles, plain: PlainDoubles| {
        let (mut x, mut y) = ([0.0; OCTET], [0.0; OCTET]);
        fast.store(&mut x);
        plain.store(&mut y);
        for lane in 0..OCTET {
            let is_same = x[lane] == y[lane] || (x[lane].is_nan() && y[lane].is_nan());
            assert!(is_same, "{operation} lane {lane}: {} {}", x[lane], y[lane]);
        }
    };
    let (s, t) = (S::Doubles::load(&a), S::Doubles::load(&b));
    let (p, q) = (PlainDoubles::load(&a), PlainDoubles::load(&b));
    run("add", s + t, p + q);
    run("sub", s - t, p - q);
    run("mul", s * t, p * q);
    run("div", s / t, p / q);
    run("neg", -s, -p);
    run("abs", s.abs(), p.abs());
    run("sqrt", s.abs().sqrt(), p.abs().sqrt());
    run("max", s.max(t), p.max(q));
    run("min", s.min(t), p.min(q));
    // These products are exact.
    let (two, three) = (S::Doubles::splat(2.0), PlainDoubles::splat(2.0));
    run("mul_add", s.mul_add(two, t), p.mul_add(three, q));
    run("mul_sub", s.mul_sub(two, t), p.mul_sub(three, q));
    run("select", S::Doubles::select(s.ge(t), s, t), PlainDoubles::select(p.ge(q), p, q));
    let flags = |mask| S::Doubles::bits(mask);
    assert_eq!(flags(s.ge(t)), 0b1101_0100);
    assert_eq!(flags(s.gt(t)), 0b1001_0000);
    assert_eq!(flags(s.lt(t)), 0b0010_0001);
    assert_eq!(flags(S::Doubles::both(s.ge(t), s.gt(t))), 0b1001_0000);
    assert_eq!(flags(S::Doubles::either(s.gt(t), s.lt(t))), 0b1011_0001);
    assert_eq!(flags(s.is_finite()), 0b1110_1101);
    let halfway = f64::from(f32::MAX) + 2.0_f64.powi(102) * 2.0;
    let edge = S::Doubles::load(&[1.0, halfway, halfway.next_down(), f64::NAN, -halfway, 0.0, -1e38, 1e39]);
    assert_eq!(flags(edge.fits_single()), 0b0110_0101);
    let mut singles = [0.0; OCTET];
    edge.store_singles(&mut singles);
    assert_eq!(flags(edge.fits_single()), flags(S::Doubles::load_singles(&singles).is_finite()));
    let positive = [1.0, 1.5, 2.0, 1e-300, 1e300, f64::MIN_POSITIVE, 0.75, f64::MAX];
    let (s, p) = (S::Doubles::load(&positive).split(), PlainDoubles::load(&positive).split());
    run("fraction", s.0, p.0);
    run("exponent", s.1, p.1);
}

simd_kernel! { fn compare() = same_as_plain }

#[test]
fn every_instruction_set_of_this_machine_agrees_with_plain_arrays() {
    for instructions in Instructions::available() {
        compare(instructions);
    }
}
