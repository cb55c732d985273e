//! 32-bit differences as byte planes: small numbers leave the upper planes zero, which zstd then packs to nothing.

/// The signed difference `new - old` of two bit patterns, modulo 2³², with the sign in the lowest bit: small
/// differences of either sign are small numbers.
pub(crate) fn zigzag_difference(new: u32, old: u32) -> u32 {
    let difference = new.wrapping_sub(old).cast_signed();
    (difference << 1 ^ difference >> 31).cast_unsigned()
}

/// Undoes [`zigzag_difference`]: the new bit pattern.
pub(crate) fn undo_zigzag(zigzag: u32, old: u32) -> u32 {
    old.wrapping_add(zigzag >> 1 ^ (zigzag & 1).wrapping_neg())
}

/// Every value minus its left neighbour, the first of a row minus the one above it.
pub(crate) fn row_differences(values: &[u32], width: usize) -> Vec<u32> {
    (0..values.len())
        .map(|index| zigzag_difference(values[index], predecessor(values, index, width)))
        .collect()
}

/// Undoes [`row_differences`].
pub(crate) fn undo_row_differences(mut differences: Vec<u32>, width: usize) -> Vec<u32> {
    for index in 0..differences.len() {
        differences[index] = undo_zigzag(differences[index], predecessor(&differences, index, width));
    }
    differences
}

fn predecessor(values: &[u32], index: usize, width: usize) -> u32 {
    match (index % width, index / width) {
        (0, 0) => 0,
        (0, _) => values[index - width],
        _ => values[index - 1],
    }
}

/// Appends the lowest `PLANES` bytes of all values: first every value's lowest byte, then every next one.
pub(crate) fn append<const PLANES: usize>(out: &mut Vec<u8>, values: &[u32]) {
    for plane in 0..PLANES {
        out.extend(values.iter().map(|value| value.to_le_bytes()[plane]));
    }
}

/// Undoes [`append`] on a slice of `PLANES` bytes per value.
pub(crate) fn values<const PLANES: usize>(bytes: &[u8]) -> Vec<u32> {
    let count = bytes.len() / PLANES;
    let value = |index: usize| {
        (0..PLANES).fold(0, |value, plane| value | u32::from(bytes[plane * count + index]) << (8 * plane))
    };
    (0..count).map(value).collect()
}

/// Bits, eight to a byte, the lowest bit first; the last byte is filled with zeros.
pub(crate) fn pack_bits(bits: impl ExactSizeIterator<Item = bool>) -> Vec<u8> {
    let mut bytes = vec![0_u8; bits.len().div_ceil(8)];
    for (index, bit) in bits.enumerate() {
        bytes[index / 8] |= u8::from(bit) << (index % 8);
    }
    bytes
}

/// Bit `index` of [`pack_bits`].
pub(crate) fn bit(bytes: &[u8], index: usize) -> bool {
    bytes[index / 8] >> (index % 8) & 1 == 1
}

/// Takes `count` bytes off the front; `None` if there are fewer.
pub(crate) fn take<'a>(bytes: &mut &'a [u8], count: usize) -> Option<&'a [u8]> {
    let (taken, rest) = bytes.split_at_checked(count)?;
    *bytes = rest;
    Some(taken)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn small_differences_are_small_numbers() {
        assert_eq!(zigzag_difference(7, 7), 0);
        assert_eq!(zigzag_difference(7, 8), 1);
        assert_eq!(zigzag_difference(8, 7), 2);
    }

    proptest! {
        #[test]
        fn everything_is_undone(
            pairs in prop::collection::vec(any::<(u32, u32)>(), 0..40),
            bits in prop::collection::vec(any::<bool>(), 0..40),
        ) {
            let (new, old): (Vec<u32>, Vec<u32>) = pairs.into_iter().unzip();
            for (&new, &old) in new.iter().zip(&old) {
                prop_assert_eq!(undo_zigzag(zigzag_difference(new, old), old), new);
            }
            let mut bytes = Vec::new();
            append::<4>(&mut bytes, &new);
            prop_assert_eq!(values::<4>(&bytes), new);
            let packed = pack_bits(bits.iter().copied());
            prop_assert!((0..bits.len()).all(|index| bit(&packed, index) == bits[index]));
        }
    }
}
