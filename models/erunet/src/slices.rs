//! The values behind a tensor on the processor, as a slice.

use candle_core::{CpuStorage, Layout, Result, Storage, Tensor, bail};

/// Hands the values of `tensor` to `read`; copied first where they do not lie in order.
pub(crate) fn values<R>(tensor: &Tensor, read: impl FnOnce(&[f32]) -> R) -> Result<R> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cpu(storage) => Ok(read(in_order(storage, layout)?)),
        _ => bail!("values wanted of a tensor that does not lie in main memory"),
    }
}

/// The values of an operand whose layout is contiguous.
pub(crate) fn in_order<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("operand does not lie in order: {layout:?}"),
    }
}
