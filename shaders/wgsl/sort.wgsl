// One pass of a stable radix sort over four bits of the keys: `histogram` per block of 1024, a scan over all of them, and
// `scatter`. A digit's place among the equal digits of its block follows from packed counters of every thread.

#import types::{State, group_number}

struct SortSettings {
    // 0: as many keys as Gaussians, 1: as many as intersections.
    list: u32,
    // Bit of the key at which the digit starts.
    shift: u32,
}

@group(0) @binding(0) var<uniform> settings: SortSettings;
@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
// Per digit and block.
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> values_out: array<u32>;

const THREADS: u32 = 256u;
const BLOCK: u32 = 1024u;
const PER_THREAD: u32 = 4u;

fn length() -> u32 {
    return select(state.gaussians, state.intersections, settings.list == 1u);
}

fn digit_of(key: u32) -> u32 {
    return (key >> settings.shift) & 15u;
}

var<workgroup> bins: array<atomic<u32>, 16>;

@compute @workgroup_size(THREADS)
fn histogram(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_number(group, groups);
    let end = length();
    let blocks = (end + BLOCK - 1u) / BLOCK;
    if block >= blocks {
        return;
    }
    if thread < 16u {
        atomicStore(&bins[thread], 0u);
    }
    workgroupBarrier();
    for (var i = 0u; i < PER_THREAD; i++) {
        let place = block * BLOCK + i * THREADS + thread;
        if place < end {
            atomicAdd(&bins[digit_of(keys[place])], 1u);
        }
    }
    workgroupBarrier();
    if thread < 16u {
        counts[thread * blocks + block] = atomicLoad(&bins[thread]);
    }
}

// Row `d % 8`, column by thread: how many of the thread's keys have digit d, in the lower half for d < 8 and in the upper
// half for the others. Afterwards, how many keys of the threads before.
var<workgroup> ranks: array<u32, 2048>;
var<workgroup> parts: array<u32, THREADS>;

// Sums up each row of `ranks`: a thread takes eight neighbours, thirty-two threads a row.
fn scan_ranks(thread: u32) {
    let first = 8u * thread;
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        sum += ranks[first + i];
    }
    parts[thread] = sum;
    workgroupBarrier();
    var before = 0u;
    for (var other = thread & 0xe0u; other < thread; other++) {
        before += parts[other];
    }
    for (var i = 0u; i < 8u; i++) {
        let own = ranks[first + i];
        ranks[first + i] = before;
        before += own;
    }
    workgroupBarrier();
}

@compute @workgroup_size(THREADS)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_number(group, groups);
    let end = length();
    let blocks = (end + BLOCK - 1u) / BLOCK;
    if block >= blocks {
        return;
    }
    for (var row = 0u; row < 8u; row++) {
        ranks[row * THREADS + thread] = 0u;
    }
    let first = block * BLOCK + PER_THREAD * thread;
    for (var place = first; place < min(first + PER_THREAD, end); place++) {
        let digit = digit_of(keys[place]);
        ranks[(digit & 7u) * THREADS + thread] += 1u << (2u * (digit & 8u));
    }
    workgroupBarrier();
    scan_ranks(thread);
    for (var place = first; place < min(first + PER_THREAD, end); place++) {
        let key = keys[place];
        let digit = digit_of(key);
        let packed = &ranks[(digit & 7u) * THREADS + thread];
        let upper = 2u * (digit & 8u);
        let rank = (*packed >> upper) & 0xffffu;
        *packed += 1u << upper;
        let to = counts[digit * blocks + block] + rank;
        keys_out[to] = key;
        values_out[to] = values[place];
    }
}
