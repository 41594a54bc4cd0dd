//! The values behind tensors on the processor, as slices.

use candle_core::{CpuStorage, Layout, Result, Storage, Tensor, bail};

/// Hands the values of `tensor` to `read`; copied first where they do not lie in order.
pub(crate) fn values<R>(tensor: &Tensor, read: impl FnOnce(&[f32]) -> R) -> Result<R> {
    all_values(&[tensor], |values| read(values[0]))
}

/// As [`values`], for several tensors at once.
pub(crate) fn all_values<R>(tensors: &[&Tensor], read: impl FnOnce(&[&[f32]]) -> R) -> Result<R> {
    let tensors: Vec<Tensor> = tensors
        .iter()
        .map(|tensor| tensor.contiguous())
        .collect::<Result<_>>()?;
    let held: Vec<_> = tensors.iter().map(Tensor::storage_and_layout).collect();
    let slices: Vec<&[f32]> = held
        .iter()
        .map(|(storage, layout)| match &**storage {
            Storage::Cpu(storage) => in_order(storage, layout),
            _ => bail!("values wanted of a tensor that does not lie in main memory"),
        })
        .collect::<Result<_>>()?;
    Ok(read(&slices))
}

/// The values of an operand whose layout is contiguous.
pub(crate) fn in_order<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("operand does not lie in order: {layout:?}"),
    }
}
