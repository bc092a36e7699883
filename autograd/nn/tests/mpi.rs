//! The exchange over MPI: this test starts itself on ranks. It needs `mpirun` of Open MPI.

use raygrad_autograd::{Tensor, Var};
use raygrad_nn::{Adam, AdamConfig, Bound, Exchange, ExchangeError, Mpi, Optimizer, ParamId, Params, TileSums, Tiles};
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// Tells a rank in which folder to write.
const FOLDER: &str = "RAYGRAD_TEST_FOLDER";

/// The loss of a tile.
fn loss<'t>(tile: usize, params: &Bound<'t, f32>, step: usize, [weight, table]: [ParamId; 2]) -> (Var<'t, f32>, f32) {
    let rows = params[table].gather_rows([(tile * 7 % 50) as u32, 3, step as u32]);
    let x = Tensor::from_fn(&[3, 50], |i| ((i + tile) as f32).cos());
    let loss = (params.tape().constant(x).matmul(&params[weight]) + rows).square().sum();
    let value = loss.item();
    (loss, value)
}

/// Trains a small model with a sparse table for some steps, alone or on ranks. Returns the bits of its parameters.
fn trained(mut exchange: Option<&mut dyn Exchange>) -> Vec<u8> {
    let mut params = Params::<f32>::new();
    let value = |i: usize| (i as f32 * 0.37).sin();
    let ids = ["weight", "table"].map(|name| params.add(name, Tensor::from_fn(&[50, 4], value)));
    params.set_lazy(|name| name == "table", true);
    let mut adam = Adam::new(AdamConfig::default());
    let tiles = Tiles::<f32>::new();
    for step in 0..6 {
        let count = 11 + step;
        let TileSums { grads, results } = match &mut exchange {
            None => tiles.differentiate(&params, count, |tile, params, ()| loss(tile, params, step, ids)),
            Some(exchange) => {
                let loss = tiles.differentiate_across(&mut **exchange, &params, count, |tile, params, ()| {
                    loss(tile, params, step, ids)
                });
                loss.unwrap()
            }
        };
        assert!(results.len() == count && results.iter().all(|loss| *loss > 0.0));
        adam.update(&mut params, &grads, 0.01).check().unwrap();
    }
    let values = params.values();
    values.iter().flat_map(|value| value.as_slice()).flat_map(|x| x.to_bits().to_le_bytes()).collect()
}

/// What each rank does.
fn rank(folder: &Path) {
    let mut mpi = Mpi::initialize(Duration::from_secs(60)).unwrap();
    let (rank, ranks) = (mpi.rank(), mpi.ranks());
    assert!(Mpi::initialize(Duration::ZERO).is_err(), "a second time");
    // Messages of all sizes: none, small ones that MPI keeps, and large ones that it hands over.
    for size in [0, 1, 1000, 3_000_000] {
        let part = |from: usize, to: usize| vec![(16 * from + to) as u8; size * (1 + from) / (1 + to)];
        let parts: Vec<Vec<u8>> = (0..ranks).map(|to| part(rank, to)).collect();
        let parts: Vec<&[u8]> = parts.iter().map(|part| &part[..]).collect();
        let expected: Vec<_> = (0..ranks).map(|from| part(from, rank)).collect();
        let before = mpi.sent_bytes();
        assert!(mpi.all_to_all(&parts).unwrap() == expected, "{size} bytes");
        let to_others: usize = (0..ranks).filter(|to| *to != rank).map(|to| parts[to].len()).sum();
        assert_eq!(mpi.sent_bytes() - before, to_others as u64);
    }
    std::fs::write(folder.join(format!("{ranks}-{rank}")), trained(Some(&mut mpi))).unwrap();
    // Another thread may not use it, and nobody may after its end.
    let elsewhere = std::thread::scope(|scope| scope.spawn(|| mpi.all_gather(&[])).join().unwrap());
    assert!(matches!(elsewhere, Err(ExchangeError::Connection(_))), "{elsewhere:?}");
    Mpi::finalize();
    assert!(matches!(mpi.all_gather(&[]), Err(ExchangeError::Connection(_))));
}

#[test]
fn ranks_get_the_bits_of_one_process() {
    if let Some(folder) = std::env::var_os(FOLDER) {
        return rank(Path::new(&folder));
    }
    let folder = std::env::temp_dir().join(format!("raygrad-mpi-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let expected = trained(None);
    for ranks in [1, 2, 3] {
        let mut job = Command::new("mpirun");
        job.args(["--allow-run-as-root", "--oversubscribe", "--bind-to", "none", "-n", &ranks.to_string()]);
        job.arg(std::env::current_exe().unwrap()).args(["--exact", "ranks_get_the_bits_of_one_process"]);
        let output = job.env(FOLDER, &folder).output().expect("mpirun of Open MPI is needed");
        assert!(output.status.success(), "{ranks} ranks: {output:?}");
        for rank in 0..ranks {
            let found = std::fs::read(folder.join(format!("{ranks}-{rank}"))).unwrap();
            assert!(found == expected, "rank {rank} of {ranks}");
        }
    }
    std::fs::remove_dir_all(folder).unwrap();
}
