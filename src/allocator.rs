//! Settings of the C library's allocator.
//!
//! glibc serves large blocks from separate memory mappings, which return to the system when the
//! blocks are freed. However, whenever such a block is freed, glibc raises the size above which it
//! maps blocks, up to 32 MiB. Images are then allocated on the heaps, together with small blocks.
//! In a long run, the heaps fragment and grow although memory use is constant, because small blocks
//! remain between freed keyframes. A fixed threshold keeps images out of the heaps.
//!
//! A fixed threshold has a cost: the kernel clears a mapped block page by page when the block is
//! first written. Pictures for viewers are such blocks. On a GPU that draws a picture in a
//! millisecond, clearing takes most of the time (H200, 1024x1024 with depth, 8 clients: 105 ms from
//! request to picture instead of 45). The setting is therefore used only with software adapters,
//! where drawing takes far longer and host memory holds images twice.

/// Blocks of at least this size get a separate mapping. An image of 640x480 takes 1.2 MB.
const MMAP_THRESHOLD_BYTES: i32 = 1 << 20;
/// Free memory at the end of a heap returns to the system above this size: twice
/// [`MMAP_THRESHOLD_BYTES`], as in glibc.
const TRIM_THRESHOLD_BYTES: i32 = 2 * MMAP_THRESHOLD_BYTES;

/// Keeps large blocks out of the heaps, unless the environment sets the allocator's thresholds.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub(crate) fn keep_images_out_of_heaps() {
    let is_set = |name: &str| std::env::var_os(name).is_some();
    if is_set("MALLOC_MMAP_THRESHOLD_") || is_set("GLIBC_TUNABLES") {
        return;
    }
    #[expect(unsafe_code, reason = "the allocator has no other interface")]
    // SAFETY: `mallopt` takes the allocator's lock, and both values are within the documented
    // range. The call affects future allocations only.
    let results = unsafe {
        [
            libc::mallopt(libc::M_MMAP_THRESHOLD, MMAP_THRESHOLD_BYTES),
            libc::mallopt(libc::M_TRIM_THRESHOLD, TRIM_THRESHOLD_BYTES),
        ]
    };
    if results.contains(&0) {
        log::debug!("the allocator rejected its settings: long runs will use more memory");
    }
}

/// Does nothing: other allocators have no such setting.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(crate) fn keep_images_out_of_heaps() {}

#[cfg(all(test, target_os = "linux", target_env = "gnu"))]
mod tests {
    use super::*;

    const N_BLOCKS: usize = 64;
    const BLOCK_BYTES: usize = 16 << 20;

    /// Total size of the blocks with separate mappings.
    fn mapped_bytes() -> usize {
        #[expect(unsafe_code, reason = "the allocator has no other interface")]
        // SAFETY: `mallinfo2` only reads the allocator's counters, under its lock.
        let info = unsafe { libc::mallinfo2() };
        info.hblkhd
    }

    #[test]
    fn images_get_separate_mappings_after_frees() {
        keep_images_out_of_heaps();
        // Without the setting, freeing this block would put the images below into a heap.
        drop(vec![1u8; 24 << 20]);
        let before = mapped_bytes();
        // These blocks are zeroed and never written, so they take address space but no memory.
        // Together they are far larger than any memory that parallel tests may free.
        let images: Vec<Vec<u8>> = (0..N_BLOCKS).map(|_| vec![0; BLOCK_BYTES]).collect();
        let grown = mapped_bytes().saturating_sub(before);
        assert!(
            grown >= N_BLOCKS / 2 * BLOCK_BYTES,
            "{grown} bytes of {} are mapped",
            images.len() * BLOCK_BYTES
        );
    }
}
