#!/bin/sh
# Measure all rows that are missing, in hours, and render the documentation: `make results`.
# An interrupted run resumes. With --again, rows that exist are measured again, too.
set -eu
python=${PYTHON:-python}
data=datasets
scene() { echo "$data/scenes/$1/images:$data/scenes/$1/sparse"; }
run() { echo "benchmarks.$*"; name=$1; shift; "$python" -m "benchmarks.$name" "$@"; }
[ "${1:-}" = "" ] || [ "$1" = --again ] || { echo "usage: results/run.sh [--again]" >&2; exit 2; }

# places
town() { # FOLDER and number of photos
    [ -e "$1/queries/ground_truth_poses.txt" ] || "$python" -c \
        'import sys; from hloc_reduce import demo; demo.main(sys.argv[1], num_photos=int(sys.argv[2]))' "$@"
}
town $data/demo_town 32
town $data/demo_town-400 400
[ -e $data/redkitchen ] || run scan_frames --sequence $data/7-scenes-redkitchen --output $data/redkitchen
split() { # KIND, PLACE, its map and options
    folder=$data/$1-$2 map=$3
    shift 3
    [ -e "$folder" ] || run split_place --map "$map" --output "$folder" "$@"
}
for place in fountain-P11 sceaux; do
    split dark $place "$(scene $place)" --gain 0.06 0.12
    split dusk $place "$(scene $place)" --gain 0.3 0.5
    split sparse $place "$(scene $place)" --map_every 4
done
for place in fountain-P11 south-building; do
    split day $place "$(scene $place)"
done
herz_jesus=$data/herz-jesus/images_upright:$data/herz-jesus/3D-models/aachen_v_1_1
split sparse herz-jesus $herz_jesus --map_every 4
[ -e $data/sparse-redkitchen ] || run split_place --sequence $data/7-scenes-redkitchen --map_every 3 \
    --output $data/sparse-redkitchen

# which feature? how many bytes?
run accuracy results/accuracy.yaml "$@"
run accuracy results/paper.yaml "$@"
run matching_ap --map "$(scene fountain-P11)" --map "$(scene sceaux)" --map "$(scene kitchen)" \
    --map $herz_jesus "$@"

for place in herz-jesus dark-fountain-P11 dark-sceaux sparse-herz-jesus sparse-fountain-P11 sparse-sceaux; do
    run lightglue --dataset $data/$place --feature mini32:uint2 --keypoints 1024 2048 "$@"
    run lightglue --dataset $data/$place --keypoints 1024 "$@" \
        --feature xfeat:float16 xfeat_sv32:uint4 xfeat_sv32:uint2 mini64:uint2
done
for place in herz-jesus dark-fountain-P11 dark-sceaux; do
    run lightglue --dataset $data/$place --feature xfeat_sv32:uint1 --keypoints 1024 "$@" \
        --map_matcher lightglue --matcher lightglue
done
run lightglue --dataset $data/herz-jesus --feature mini32:uint2 --keypoints 512 1024 2048 --num_loc 3 5 20 "$@" \
    --map_matcher lightglue --matcher lightglue
# LightGlue for ALIKED takes minutes a place and feature, and the town an hour
for place in herz-jesus dark-fountain-P11 dark-sceaux sparse-herz-jesus; do
    run lightglue --dataset $data/$place --keypoints 1024 --map_matcher lightglue --matcher lightglue "$@" \
        --feature aliked:float16 aliked_sv32:uint4 aliked_sv32:uint2
done
for place in herz-jesus dark-fountain-P11 dark-sceaux; do
    run lightglue --dataset $data/$place --keypoints 1024 --map_matcher lightglue --matcher lightglue "$@" \
        --feature aliked_sv32:uint1
done
for place in herz-jesus dark-fountain-P11 dark-sceaux sparse-herz-jesus sparse-fountain-P11 sparse-sceaux; do
    run lightglue --dataset $data/$place --feature mini32:uint2 --keypoints 2048 --matcher NN+lightglue "$@"
done
run lightglue --dataset $data/demo_town --feature mini32:uint2 --keypoints 2048 --map_matcher NN \
    --matcher NN NN+lightglue "$@"
run lightglue --dataset $data/demo_town --feature mini32:uint2 --keypoints 2048 "$@" \
    --map_matcher lightglue --matcher lightglue

# how small a map?
small_maps() { # PLACE, FEATURE, STORAGE and sizes
    place=$1 feature=$2 storage=$3
    shift 3
    run small_maps --dataset $data/$place --feature $feature --storage $storage --max_mb "$@"
}
small_maps herz-jesus colmap_sift_sv32 uint4 0.006 0.0075 0.01 0.015 0.02 0.03 0.06 0.1 "$@"
small_maps herz-jesus xfeat_sv32 uint2 0.006 0.0075 0.01 0.015 0.02 0.03 0.06 0.1 "$@"
small_maps herz-jesus mini32 uint2 0.006 0.0075 0.01 0.015 0.02 0.03 0.06 0.1 "$@"
for storage in uint1 uint2 uint4; do # how many bytes a point, for LightGlue?
    small_maps herz-jesus mini32 $storage 0.0075 0.03 --matcher lightglue "$@"
done
small_maps herz-jesus xfeat_sv32 uint2 0.03 0.1 --matcher lightglue "$@"
small_maps demo_town-400 colmap_sift_sv32 uint4 0.083 0.1 0.125 0.17 0.25 0.5 1 "$@"
small_maps day-south-building colmap_sift_sv32 uint4 0.006 0.0075 0.01 0.0175 0.02 0.025 "$@"
small_maps sparse-redkitchen colmap_sift_sv32 uint4 0.006 0.0075 0.01 0.015 0.03 "$@"
others="cover triplets longest random" # which points?
small_maps herz-jesus colmap_sift_sv32 uint4 0.0075 0.015 0.02 0.03 0.06 0.1 --selection $others "$@"
small_maps herz-jesus mini32 uint2 0.0075 0.015 0.02 0.03 0.06 0.1 --selection $others "$@"
small_maps day-south-building colmap_sift_sv32 uint4 0.0075 0.0175 0.02 0.025 --selection $others "$@"
small_maps sparse-redkitchen colmap_sift_sv32 uint4 0.0075 0.015 0.03 --selection $others "$@"
small_maps demo_town-400 colmap_sift_sv32 uint4 0.083 0.12 0.17 --selection cover triplets "$@"

run metres --map "$(scene fountain-P11)" --map "$(scene entry-P10)" --map $herz_jesus "$@"
run tracking --feature colmap_sift_sv32:uint4 mini32:uint2 --strangers $data/strangers "$@"
run rigs --feature colmap_sift_sv64 mini32:uint2 "$@"
run rigs --dataset $data/demo_town-400 --feature colmap_sift_sv64 "$@"
run rigs --feature colmap_sift_sv64 mini32:uint2 "$@" \
    --strangers $data/scenes/fountain-P11/images $data/scenes/sceaux/images
run rigs --feature colmap_sift_sv64 mini32:uint2 "$@" \
    --halves $data/herz-jesus $data/dark-fountain-P11 $data/dark-sceaux
run panoramas --feature colmap_sift_sv64 "$@"
mappers= # of photos alone
for place in bronze-statue cyprus entry-P10 fountain-P11 fox kitchen liberty-statue monstree sceaux south-building; do
    mappers="$mappers --map $(scene "$place")"
done
run mappers $mappers --map $data/demo_town-400/images_upright:$data/demo_town-400/3D-models/aachen_v_1_1 "$@"
run adding --map "$(scene south-building)" "$@"
run adding --map $data/demo_town-400/images_upright:$data/demo_town-400/3D-models/aachen_v_1_1 --photos 100 "$@"

run mappers --single --mapper incremental "incremental, rare adjustments" \
    --map "$(scene fox)" --map "$(scene south-building)" "$@"

# how often wrong?
[ -e $data/strangers ] || run strangers --output $data/strangers || true # from GitHub
web="$data/strangers/naver+mast3r $data/strangers/cvg+Hierarchical-Localization"
if [ -e $data/strangers ]; then
    run own_maps --photos $web --feature colmap_sift_sv64 --matcher NN "$@"
    run own_maps --photos $web --feature xfeat:float16 xfeat_sv32:uint2 mini32:uint2 "$@"
fi
for place in fountain-P11 bronze-statue monstree sceaux cyprus entry-P10; do
    run own_maps --matcher NN --map "$(scene $place)" "$@" \
        --feature colmap_sift_sv64 mini64:uint2 mini32:uint2 xfeat_sv32:uint2
    run own_maps --matcher NN --map "$(scene $place)" --feature mini32:uint2 --keypoints 1024 2048 "$@"
done
for feature in mini32:uint2 xfeat_sv32:uint2 colmap_sift_sv64; do
    changed() { run changed_photos --dataset $data/herz-jesus --feature $feature "$@"; }
    changed --size 1 0.5 0.35 0.25 "$@"
    changed --size 1 --map_size 0.5 0.35 "$@"
    changed --size 1 --map_size 0.35 --mixed "$@"
    changed --size 1 --part 0.5 "$@"
    changed --size 1 --turns 1 2 "$@"
done
run pose_limits results/pose_limits.yaml "$@"
# fox and south-building, whose images are all matched with each photo, only with the default feature
small="bronze-statue cyprus entry-P10 fountain-P11 kitchen liberty-statue monstree sceaux"
tried() { # maps of PLACES, features and other options
    maps=
    for place in $1; do maps="$maps --map $(scene "$place")"; done
    shift
    run trials $maps --same entry-P10 fountain-P11 herz-jesus --trials 60 --strangers $data/strangers "$@"
}
tried "$small fox south-building" --dataset $data/herz-jesus --feature colmap_sift_sv64 "$@"
tried "$small" --dataset $data/herz-jesus --feature xfeat_sv32 "$@"
for feature in mini32:uint2 xfeat_sv32:uint2; do # photos without EXIF data are tried four ways
    tried "fountain-P11 sceaux" --feature $feature --turned --seed 3 --trials 20 "$@"
done
tried "fountain-P11 sceaux" --feature colmap_sift_sv64 --keypoints fast --trials 40 "$@"
tried "$small" --dataset $data/herz-jesus --feature colmap_sift_sv64 --seed 1 "$@"
tried "bronze-statue cyprus entry-P10 fountain-P11 kitchen" --dataset $data/herz-jesus --feature colmap_sift_sv16 "$@"
# one core takes a quarter of an hour for each place, and hours for those with more images
tried "fountain-P11 sceaux entry-P10 bronze-statue cyprus" --feature mini32:uint2 --matcher lightglue --trials 30 "$@"
for feature in mini64:uint2 xfeat_sv32:uint2; do
    tried "fountain-P11 sceaux" --feature $feature --matcher lightglue --trials 20 "$@"
done

# how fast?
run extraction --dataset $data/herz-jesus "$@" \
    --feature colmap_sift colmap_sift_sv64 sift_sv64 mini32 mini64 edgepoint2_m32 edgepoint2_m64 xfeat aliked
run extraction_parts --images $data/demo_town-400/images_upright --photos 30 300 "$@" \
    --feature colmap_sift_sv64 mini64
run keypoint_steps --scenes $data/scenes "$@"
run keypoint_steps --scenes $data/scenes --place cyprus fountain-P11 kitchen sceaux --fast "$@"
run matching "$@"
ransacs() {
    run ransacs --dataset $data/herz-jesus $data/demo_town "$@" \
        --feature colmap_sift_sv32:uint4 mini32:uint2
}
ransacs "$@"
oldest=.venv/pycolmap-3.13.0 # from make check
[ ! -d $oldest ] || (export PYTHONPATH=$PWD/$oldest && ransacs "$@")
run lightglue_seconds --dataset $data/herz-jesus --feature mini32 --rounds 2 "$@"
run lightglue_seconds --dataset $data/herz-jesus --feature aliked --keypoints 512 1024 2048 --pairs 2 --rounds 1 "$@"
run video --frames 100 "$@"
run video --sequence $data/7-scenes-redkitchen "$@"
run video --frames 100 --encode "$@"
run video --frames 300 "$@" # exhaustive pairs may take more than an hour
for video in outputs/video/demo_town-100 outputs/video/demo_town-300; do
    run mappers --map $video/frames:$video/reference --database $video/map-sequential/sfm/database.db "$@" \
        --single --mapper incremental "incremental, rare adjustments"
done
run retrieval_scale --dataset $data/demo_town-400 "$@"
run aachen_scale --data $data/aachen_v1.1 --share 0.004 0.01 --dim 64 "$@"
run aachen_scale --data $data/aachen_v1.1 --share 0.004 0.01 --dim 32 --storage uint4 "$@"
run triangulation_scale --data $data/aachen_v1.1 --share 0.05 0.1 "$@"
run compact_scale --data $data/aachen_v1.1 --share 0.1 1 10 30 100 "$@" # the last one writes 5 GB
run compact_scale --data $data/aachen_v1.1 --share 1 --max_mb 10 "$@"
if "$python" -c "import hloc" 2> /dev/null; then
    for place in herz-jesus day-fountain-P11; do
        run against_hloc --dataset $data/$place --keypoints adaptive hloc fast "$@" \
            --feature sift_sv64 colmap_sift_sv64 colmap_sift_sv16 xfeat_sv32:uint2 mini32:uint2
    done
    mkdir -p outputs
    { # photos of 1,600 pixels take half a minute
        echo "model: {name: disk, max_keypoints: 4096}"
        echo "preprocessing: {grayscale: false, resize_max: 1024}"
    } > outputs/disk.yaml
    for matcher in NN-mutual lightglue; do
        run lightglue --dataset $data/dark-fountain-P11 --feature outputs/disk.yaml:float16 --keypoints 1024 "$@" \
            --map_matcher $matcher --matcher $matcher
    done
    projected=outputs/disk_sv32.safetensors
    if [ ! -e $projected ]; then # half an hour
        maps= images=
        for place in bronze-statue cyprus entry-P10 liberty-statue monstree; do
            maps="$maps --map $(scene "$place")" images="$images $data/scenes/$place/images"
        done
        { # as disk.yaml, projected
            echo "model: {name: reduced, base: {name: disk, max_keypoints: 4096}, projection: $projected}"
            echo "preprocessing: {grayscale: false, resize_max: 1024}"
        } > outputs/disk_sv32.yaml
        "$python" -m hloc_reduce.training --base outputs/disk.yaml --scheme sv --dim 32 $maps --output outputs
        "$python" -m hloc_reduce.training.adapters --feature outputs/disk_sv32.yaml --photos 40 --images $images
    fi
    run lightglue --dataset $data/dark-fountain-P11 --feature outputs/disk_sv32.yaml:uint4 \
        outputs/disk_sv32.yaml:uint2 --keypoints 1024 --map_matcher lightglue --matcher lightglue "$@"
fi

run render
