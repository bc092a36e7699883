use super::across::{message, parts_of, tiles_of};
use super::*;
use crate::exchange::{ExchangeError, Reader};
use crate::{Exchange, InProcess, ParamId};
use raygrad_autograd::{SparseGrad, SparseParts};
use raygrad_tensor::Tensor;
use std::sync::Arc;

/// Two matrices, and a table of which few rows are used.
fn store() -> (Params<f32>, [ParamId; 3]) {
    let mut params = Params::new();
    let value = |i: usize| (i as f32 * 0.37).sin();
    let mut add = |name: &str, shape: [usize; 2]| params.add(name, Tensor::from_fn(&shape, value));
    let ids = [add("a", [6, 3]), add("b", [4, 3]), add("table", [7, 2])];
    (params, ids)
}

/// The loss of a tile: of `b` only in every third one.
fn loss<'t>(tile: usize, params: &Bound<'t, f32>, [a, b, table]: [ParamId; 3]) -> (Var<'t, f32>, f32) {
    let x = Tensor::from_fn(&[4, 6], |i| ((i + 5 * tile) as f32).cos());
    let mut y = params.tape().constant(x).matmul(&params[a]);
    if tile % 3 == 1 {
        y *= &params[b];
    }
    let rows = params[table].gather_rows([tile as u32 % 6, 2]).sum();
    let loss = y.square().sum() + rows.square();
    let value = loss.item();
    (loss, value)
}

#[test]
fn tiled_gradient_equals_sum_of_tiles() {
    let (params, ids) = store();
    let tiles = Tiles::<f32>::new();
    for count in [1, 3, 8, 100, 19, 2, 0] {
        let TileSums { grads, results } =
            tiles.differentiate(&params, count, |tile, params, _| loss(tile, params, ids));
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let all: Vec<_> = (0..count).map(|tile| loss(tile, &bound, ids)).collect();
        assert_eq!(results, all.iter().map(|(_, value)| *value).collect::<Vec<_>>());
        let Some(sum) = all.into_iter().map(|(loss, _)| loss).reduce(|a, b| a + b) else {
            assert!(grads.iter().all(Gradient::is_zero) && grads.len() == 3);
            continue;
        };
        let expected = sum.backward(&bound.vars());
        assert_eq!(grads.len(), 3);
        assert!(grads[2].is_rows() && grads[2].sparse().len() == count && grads[1].is_zero() == (count < 2));
        for (tile, share) in grads[2].sparse().iter().enumerate() {
            let mut sums = raygrad_autograd::RowSums::new(7, 2);
            share.as_rows().unwrap().scatter(&mut sums);
            assert_eq!(sums.rows()[0], tile as u32 % 6, "in the order of the tiles");
        }
        for (grad, expected) in grads.iter().zip(expected) {
            let (grad, expected) = (grad.clone().into_dense(&Pool::none()), expected.into_dense(&Pool::none()));
            let pairs = grad.as_slice().iter().zip(expected.as_slice());
            let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, raygrad_tensor::Real::maximum);
            assert!(worst <= 1e-5 * 10.max(count) as f32, "{count} tiles: {worst}");
        }
    }
}

#[test]
fn halves_are_added_first() {
    let mut params = Params::new();
    let x = params.add("x", Tensor::scalar(1.0_f32));
    let v = [1e8, 1.0, -1e8, 0.3, 5.7, 1e7, 0.01, -1e7];
    let sum = |count: usize| {
        let step =
            Tiles::<f32>::new().differentiate(&params, count, |tile, params, ()| (&params[x] * f64::from(v[tile]), ()));
        step.grads[0].dense().unwrap().item()
    };
    assert_eq!(sum(8), ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])));
    assert_eq!(sum(5), (v[0] + v[1]) + (v[2] + (v[3] + v[4])));
}

#[test]
fn another_model_may_follow() {
    let tiles = Tiles::<f64>::new();
    for shape in [[2, 3], [3, 2], [4, 5], [2, 3]] {
        let mut params = Params::new();
        let x = params.add("x", Tensor::ones(&shape));
        let step = tiles.differentiate(&params, 10, |_, params, _| (params[x].square().sum(), ()));
        assert_eq!(step.grads[0].shape(), shape);
        assert_eq!(step.grads[0].dense().unwrap(), &Tensor::full(&shape, 20.0));
    }
}

/// Gradients, results and sent bytes of steps of 21, 5 and 0 tiles, on each of several ranks.
fn across(count: usize, frozen: &str) -> Vec<(Vec<Vec<f32>>, Vec<f32>, u64)> {
    let train = |mut exchange: InProcess| {
        let (mut params, ids) = store();
        params.freeze(|name| name == frozen);
        let tiles = Tiles::<f32>::new();
        let mut steps = (vec![], vec![], 0);
        for tile_count in [21, 5, 0] {
            let TileSums { grads, results } = tiles
                .differentiate_across(&mut exchange, &params, tile_count, |tile, params, _| loss(tile, params, ids))
                .unwrap();
            let table = grads.last().unwrap();
            assert!(table.is_rows() && table.sparse().len() == tile_count);
            let ids: Vec<ParamId> = params.trainable().collect();
            for (grad, id) in grads.iter().zip(ids) {
                let dense = grad.clone().into_dense(&Pool::none());
                steps.0.push(dense.as_slice().to_vec());
                *params.get_mut(id) += &dense;
            }
            steps.1.extend(results);
        }
        (steps.0, steps.1, exchange.sent_bytes())
    };
    std::thread::scope(|scope| {
        let start = |exchange| scope.spawn(move || train(exchange));
        let ranks: Vec<_> = InProcess::ranks(count).into_iter().map(start).collect();
        ranks.into_iter().map(|rank| rank.join().unwrap()).collect()
    })
}

#[test]
fn tiles_any_processes_give_same_bits() {
    for frozen in ["", "a"] {
        let (mut params, ids) = store();
        params.freeze(|name| name == frozen);
        let tiles = Tiles::<f32>::new();
        let mut expected = (vec![], vec![]);
        for tile_count in [21, 5, 0] {
            let step = tiles.differentiate(&params, tile_count, |tile, params, _| loss(tile, params, ids));
            let trainable: Vec<ParamId> = params.trainable().collect();
            for (grad, id) in step.grads.iter().zip(trainable) {
                let dense = grad.clone().into_dense(&Pool::none());
                expected.0.push(dense.as_slice().to_vec());
                *params.get_mut(id) += &dense;
            }
            expected.1.extend(step.results);
        }
        for count in [1, 2, 3, 4, 5, 8, 11, 25] {
            for (rank, (grads, results, sent)) in across(count, frozen).into_iter().enumerate() {
                assert!((&grads, &results) == (&expected.0, &expected.1), "rank {rank} of {count}");
                assert_eq!(sent > 0, count > 1);
            }
        }
    }
}

/// A contribution that cannot be sent, or one of an unknown kind.
#[derive(Clone)]
struct Foreign(Option<&'static str>);

impl SparseGrad<f32> for Foreign {
    fn shape(&self) -> &[usize] {
        &[7, 2]
    }
    fn add_to(&self, _: &mut Tensor<f32>) {}
    fn to_parts(&self) -> Option<SparseParts<f32>> {
        Some(SparseParts { kind: self.0?.into(), integers: [1, 2].into(), tensors: vec![] })
    }
}

/// Those of the first 5 tiles of 9, as a rank sends them.
fn parts(params: &Params<f32>, ids: [ParamId; 3]) -> Vec<Part<f32, f32>> {
    Tiles::<f32>::new().run(params, 0..9, 0..5, &|tile, params, (): &mut ()| loss(tile, params, ids))
}

fn add_share(parts: &mut [Part<f32, f32>], share: impl SparseGrad<f32>) {
    parts[0].1.grads[2].add_sparse(Arc::new(share));
}

#[test]
fn sparse_gradients_need_parts_and_a_reader() {
    let (params, ids) = store();
    let mut own = parts(&params, ids);
    add_share(&mut own, Foreign(None));
    let error = message(&params, 9, &own).unwrap_err();
    assert_eq!(error, ExchangeError::NotSent { param: "table".into() });
    let mut own = parts(&params, ids);
    add_share(&mut own, Foreign(Some("foreign")));
    let message = message(&params, 9, &own).unwrap();
    let read = |tiles: Tiles<f32>| tiles.receive::<f32>(&params, 9, 0..5, &mut Reader(&message));
    let error = read(Tiles::new()).err().unwrap();
    assert!(error.contains("of kind `foreign` for `table`"), "{error}");
    let reader: ReadSparse<f32> = |shape, parts| {
        let is_whole = shape == [7, 2] && *parts.integers == [1, 2] && parts.tensors.is_empty();
        is_whole.then(|| Arc::new(Foreign(None)) as Arc<dyn SparseGrad<f32>>)
    };
    assert_eq!(read(Tiles::new().with_reader("foreign", reader)).unwrap()[0].1.grads[2].sparse().len(), 5);
}

#[test]
fn ranks_that_differ_are_named() {
    let train = |mut exchange: InProcess, tile_count: usize| {
        let (params, ids) = store();
        let tiles = Tiles::<f32>::new();
        let step =
            tiles.differentiate_across(&mut exchange, &params, tile_count, |tile, params, _| loss(tile, params, ids));
        step.err()
    };
    let errors: Vec<_> = std::thread::scope(|scope| {
        let ranks: Vec<_> = InProcess::ranks(2)
            .into_iter()
            .map(|exchange| (3 + exchange.rank(), exchange))
            .map(|(count, exchange)| scope.spawn(move || train(exchange, count)))
            .collect();
        ranks.into_iter().map(|rank| rank.join().unwrap()).collect()
    });
    for (rank, error) in errors.into_iter().enumerate() {
        let Some(ExchangeError::Differs { rank: other, what }) = error else { panic!("{error:?}") };
        assert!(other == 1 - rank && what.contains(&format!("has {} tiles", 4 - rank)), "{what}");
    }
}

/// As many parameters of the same shape, but others.
#[test]
fn parameters_of_other_ranks_are_compared_by_name() {
    let store = |frozen: &str, second: &str| {
        let mut params = Params::<f32>::new();
        params.add("a", Tensor::zeros(&[3]));
        params.add(second, Tensor::zeros(&[3]));
        params.freeze(|name| name == frozen);
        params
    };
    let sums = |params: &Params<f32>| vec![(0..1, TileSums::<f32, f32>::zero(params))];
    let mine = store("a", "b");
    for (other, is_same) in [(store("b", "b"), false), (store("a", "c"), false), (store("a", "b"), true)] {
        let mut parts = sums(&other);
        parts[0].1.results.push(1.0);
        let message = message(&other, 1, &parts).unwrap();
        let read = Tiles::<f32>::new().receive::<f32>(&mine, 1, 0..1, &mut Reader(&message));
        assert_eq!(read.is_ok(), is_same);
        assert!(read.err().is_none_or(|what| what.contains("other names or shapes")));
    }
}

#[test]
fn messages_hold_sums_and_cut_ones_are_refused() {
    let (params, ids) = store();
    let own = parts(&params, ids);
    // The first half of nine, and the first tile of the second.
    let ranges: Vec<_> = own.iter().map(|(range, _)| range.clone()).collect();
    assert_eq!(ranges, [0..4, 4..5]);
    let whole = message(&params, 9, &own).unwrap();
    let read = |message: &[u8]| Tiles::<f32>::new().receive::<f32>(&params, 9, 0..5, &mut Reader(message));
    for ((range, sums), (own_range, own)) in read(&whole).unwrap().iter().zip(&own) {
        assert!(range == own_range && sums.results == own.results && sums.grads.len() == 3);
        for (sum, own) in sums.grads.iter().zip(&own.grads) {
            let [sum, own] = [sum, own].map(|grad| grad.clone().into_dense(&Pool::none()));
            assert!(sum == own);
        }
    }
    for len in 0..whole.len() {
        assert!(read(&whole[..len]).is_err(), "{len} bytes");
    }
    assert!(read(&[&whole[..], &[0]].concat()).is_err(), "a byte too many");
    // The numbers of tiles, of parameters, and of bytes.
    for at in [0, 8, 16] {
        let mut message = whole.clone();
        message[at] ^= 1;
        assert!(read(&message).is_err(), "byte {at}");
    }
    // A sum of another shape; a row that does not exist; rows of another width.
    type Parts = [Part<f32, f32>];
    type Change<'a> = &'a dyn Fn(&mut Parts);
    let refused = |change: Change<'_>| {
        let mut own = parts(&params, ids);
        change(&mut own);
        read(&message(&params, 9, &own).unwrap()).err().unwrap()
    };
    let set = |parts: &mut Parts, i: usize, shape: &[usize]| {
        parts[0].1.grads[i] = Tensor::<f32>::ones(shape).into();
    };
    let set_rows = |parts: &mut Parts, shape: [usize; 2], row: u32| {
        parts[0].1.grads[2] = Gradient::zero(&shape);
        add_share(parts, RowGrad::new(&shape, [row].into(), Tensor::<f32>::ones(&[1, shape[1]])));
    };
    let changes: [(&str, Change<'_>); 4] = [
        ("shape of a sum", &|parts| set(parts, 0, &[3, 6])),
        ("shape of a table", &|parts| set(parts, 2, &[2, 7])),
        ("row 7 of 7", &|parts| set_rows(parts, [8, 2], 7)),
        ("rows of width 3", &|parts| set_rows(parts, [7, 3], 0)),
    ];
    for (what, change) in changes {
        assert!(refused(change).contains("cannot be read"), "{what}");
    }
    let mut fewer = parts(&params, ids);
    fewer[0].1.results.pop();
    assert!(read(&message(&params, 9, &fewer).unwrap()).is_err(), "a result is missing");
}

#[test]
fn parts_of_ranks_make_the_tree() {
    for count in [0, 1, 2, 5, 8, 13] {
        for ranks in 1..=15 {
            let own: Vec<_> = (0..ranks).map(|rank| tiles_of(rank, ranks, count)).collect();
            let tiles: Vec<usize> = own.iter().flat_map(|own| own.clone()).collect();
            assert_eq!(tiles, (0..count).collect::<Vec<_>>());
            let even = own.iter().map(|own| own.len() * ranks).all(|len| len.abs_diff(count) < ranks);
            assert!(even, "{count} tiles on {ranks} ranks: {own:?}");
            for own in own {
                let is_inside = |range: &Range<usize>| own.start <= range.start && range.end <= own.end;
                // Ranges of the tree with their parents, in the order of their tiles.
                let mut nodes = vec![(0..count, 0..ranks * count + 1)];
                let mut at = 0;
                while let Some((range, _)) = nodes.get(at).cloned() {
                    nodes.extend(halves(&range).into_iter().flatten().map(|half| (half, range.clone())));
                    at += 1;
                }
                let largest = nodes.into_iter().filter(|(range, parent)| is_inside(range) && !is_inside(parent));
                let mut expected: Vec<_> = largest.map(|(range, _)| range).filter(|range| !range.is_empty()).collect();
                expected.sort_by_key(|range| range.start);
                assert_eq!(parts_of(0..count, &own), expected, "{own:?} of {count}");
            }
        }
    }
    assert_eq!(parts_of(0..8, &(2..8)), [2..4, 4..8]);
}

#[test]
fn tiles_any_threads_give_same_bits() {
    let (mut params, ids) = store();
    params.freeze(|name| name == "b");
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let tiles = Tiles::<f32, Vec<usize>>::new();
        let step = || {
            let step = tiles.differentiate(&params, 21, |tile, params, seen| {
                seen.push(tile); // kept from tile to tile
                loss(tile, params, ids)
            });
            let dense: Vec<Vec<f32>> =
                step.grads.iter().map(|grad| grad.clone().into_dense(&Pool::none()).as_slice().to_vec()).collect();
            (dense, step.results)
        };
        let both = pool.install(|| [step(), step()]);
        let seen: usize = locked(&tiles.free).iter().map(|(_, seen)| seen.len()).sum();
        assert!(seen == 42 && locked(&tiles.free).len() <= threads);
        both
    };
    let [first, second] = run(1);
    assert!(first == second && first.0.len() == 2);
    for threads in [2, 3, 8, 21] {
        assert!(run(threads) == [first.clone(), second.clone()], "{threads} threads");
    }
}
